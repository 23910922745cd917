"""For nbval, which runs the notebooks here under pytest."""

import os

# The notebooks' kernels inherit these, as in `rover run`.
from rover_lib.workshop.run import KERNEL_ENVIRONMENT


def pytest_sessionstart():
    for name, value in KERNEL_ENVIRONMENT.items():
        os.environ.setdefault(name, value)


def pytest_collection_modifyitems(items):
    """Count every cell as run: nbval takes a missing execution count for a cell whose output is not to be trusted, and
    the committed notebooks have no counts, because they would change with every publication.
    """
    for item in items:
        cell = getattr(item, "cell", None)
        if cell is not None and cell.get("execution_count") is None:
            cell.execution_count = 0
