"""Open a run's notebooks in JupyterLab, on a copy of the run: cells that are executed again there change no run.

    python -m rover_lib.workshop.run.copy_run demo try1     # what `make notebooks-open NAME=demo AS=try1` does

The copy is a run like any other: `rover report runs/try1` judges it again, and `rover inspect` says whether it must.
"""

import os
import shutil
import sys
from pathlib import Path

from rover_lib.onboard.durable import build_folder
from rover_lib.onboard.errors import RoverError
from rover_lib.workshop.run.run import KERNEL_ENVIRONMENT, NAMES, NOTEBOOKS, files_of_a_run
from rover_lib.workshop.run.run_folder import run_folder


def copy_run(name: str, copy: str = "", runs_dir: Path | str = "runs") -> Path:
    """Copy what a run left to the run `copy` (<name>-copy if empty) and return that folder; a copy that is there stays.

    Its notebooks then work in it; checkpoint and recordings stay where they are. Raises RoverError if there is no
    such run, or if the copy would be the run itself or is a folder of something else.
    """
    source, folder = (run_folder(runs_dir, n, RoverError) for n in (name, copy or f"{name}-copy"))
    first = f"{NAMES[0]}.ipynb"
    if not (source / first).is_file():
        raise RoverError(f"there is no run {source}", remedy="rover inspect shows the runs that there are")
    if folder == source or (folder.exists() and not (folder / first).is_file()):
        what = f"{folder}: is the run itself, or no copy of one"
        raise RoverError(what, remedy="give the copy another name: AS=try1")
    if not folder.exists():
        with build_folder(folder) as new:
            for path in {*files_of_a_run(source), *source.glob("benchmark-*.json")}:
                (shutil.copytree if path.is_dir() else shutil.copy2)(path, new / path.name)
    return folder


def main() -> None:
    """Replace this process by JupyterLab on the copy of a run, or on the repository's notebooks if no run is named."""
    name, copy = (*sys.argv[1:], "", "")[:2]
    try:
        folder = copy_run(name, copy) if name else NOTEBOOKS
    except RoverError as error:
        sys.exit(f"rover: {error}")
    root = ["--allow-root"] if os.geteuid() == 0 else []  # a container may have no other user
    print(f"opening {folder}", file=sys.stderr)
    first = f"--LabApp.default_url=/lab/tree/{NAMES[0]}.ipynb"  # in the address that it prints, too
    os.environ.update(KERNEL_ENVIRONMENT)
    os.execv(sys.executable, [sys.executable, "-m", "jupyterlab", *root, first, str(folder)])


if __name__ == "__main__":
    main()
