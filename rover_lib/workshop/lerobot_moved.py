"""What LeRobot has moved between 0.4.4 and 0.6, which both work here. Nothing else asks which of them is installed.

LeRobot is imported in the functions, because that takes seconds.
"""

import shlex
from contextlib import AbstractContextManager
from importlib.util import find_spec
from pathlib import Path


def no_progress_bars() -> AbstractContextManager:
    """Return a context in which LeRobot's datasets draw no bars."""
    try:
        from lerobot.utils.utils import SuppressProgressBars  # 0.6
    except ImportError:
        from lerobot.datasets.utils import SuppressProgressBars  # 0.4
    return SuppressProgressBars()


def conversion(root: Path, hub_id: str = "") -> str:
    """Return LeRobot's command that converts a dataset of v2.1 to v3 in place, and publishes nothing.

    hub_id: user/name of a dataset on the Hub, which it then fetches; else the folder `root` is converted.
    """
    new = find_spec("lerobot") and find_spec("lerobot.scripts.convert_dataset_v21_to_v30")
    module, root = "lerobot.scripts" if new else "lerobot.datasets.v30", root.resolve()
    if hub_id:
        given = [f"--repo-id={hub_id}"]
    elif new:
        given = [f"--repo-id=local/{root.name}", f"--root={root}"]
    else:  # 0.4 takes the folder around it, and joins the two
        given = [f"--repo-id={root.name}", f"--root={root.parent}"]
    return shlex.join(["python", "-m", f"{module}.convert_dataset_v21_to_v30", *given, "--push-to-hub=false"])
