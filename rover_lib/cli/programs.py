"""Commands that start another program on files of this project: Ansible on its playbooks, JupyterLab on a run."""

import os
import shutil
import sys
from pathlib import Path

import click

from rover_lib.onboard.durable import build_folder
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.kinds import PathTo

COPIED = ("*.ipynb", "*.json", "policy_*", "calibration*.pt", "figures")  # of a run; its checkpoint and recordings stay
NO_ANSIBLE = "pip install 'rover-policy[workshop]', or ansible-core alone"


@click.command(
    short_help="Install rovers, deploy to them, and drive them, by Ansible.",
    context_settings={"ignore_unknown_options": True, "allow_interspersed_args": False},
)
@click.argument("name", required=False)
@click.argument("options", nargs=-1, type=click.UNPROCESSED, metavar="[OPTIONS OF ansible-playbook]...")
def playbook(name: str | None, options: tuple[str, ...]) -> None:
    """Run the playbook NAME, such as deploy, by ansible-playbook. Without NAME, list the playbooks and their folder.

    The rovers are those of inventory.ini in the current folder, or of -i. Where there is none, it is rover1.local.
    """
    from rover_lib.workshop.installed import SHIPPED

    folder, own = SHIPPED / "ansible", Path("inventory.ini")
    books = {path.stem: path for path in sorted(folder.glob("*.yml"))}
    inventory = own if own.is_file() else SHIPPED / own
    if name is None:
        listed = [(stem, path.read_text().partition("- name: ")[2].partition("\n")[0]) for stem, path in books.items()]
        click.echo("\n".join(f"{stem:<10} {title}" for stem, title in listed))
        return click.echo(f"folder     {folder}\ninventory  {inventory}")
    if name not in books:
        raise RoverError(f"no playbook {name}", remedy=f"known are {', '.join(books)}")
    playbook_path = Path(sys.executable).with_name("ansible-playbook")
    if not (program := str(playbook_path) if playbook_path.is_file() else shutil.which(playbook_path.name)):
        raise RoverError("this command needs ansible-playbook", remedy=NO_ANSIBLE)
    has_inventory = any(word.startswith(("-i", "--inv")) for word in options)
    words = [program, *([] if has_inventory else ["-i", str(inventory)]), str(books[name]), *options]
    # The role makes the rover's wheel by this program, and takes paths from this folder.
    here = {"ROVER_COMMAND": str(playbook_path.with_name("rover")), "PWD": str(Path.cwd())}
    os.execve(program, words, {**os.environ, **here})


@click.command(short_help="Open a copy of a run's notebooks in JupyterLab.")
@click.argument("run_dir", type=PathTo("run"))
@click.option("--as", "name", help="The copy's name, beside the run [default: the run's, with -copy].")
def notebooks(run_dir: Path, name: str | None) -> None:
    """Open a copy of the notebooks of RUN_DIR, with their outputs, in JupyterLab. A copy that is there is opened again.

    Cells that are run again there change no run. `rover report` judges the copy.
    """
    from rover_lib.workshop.run import run_folder
    from rover_lib.workshop.run.run import JUPYTER, KERNEL_ENVIRONMENT

    run_dir = run_dir.absolute()  # beside a link, not beside what it leads to
    copy = run_folder(run_dir.parent, name or f"{run_dir.name}-copy", RoverError)
    first = "01_load.ipynb"
    if not (run_dir / first).is_file():
        raise RoverError(f"{run_dir}: no notebooks in it", remedy="rover run makes a run with notebooks")
    if copy == run_dir.resolve() or (copy.exists() and not (copy / first).is_file()):
        raise RoverError(f"{copy}: is the run itself, or no copy of one", remedy="name the copy otherwise: --as try1")
    if not copy.exists():
        with build_folder(copy) as new:
            for path in (path for pattern in COPIED for path in run_dir.glob(pattern)):
                if path.is_dir():
                    shutil.copytree(path, new / path.name)
                else:
                    shutil.copy2(path, new)
    own = ["--allow-root"] if os.geteuid() == 0 else []  # a container may have no user but root
    words = [sys.executable, "-m", "jupyterlab", *own, f"--LabApp.default_url=/lab/tree/{first}", str(copy)]
    # JupyterLab then saves widgets' state, without which a notebook that is opened again shows errors in their place.
    settings = os.pathsep.join(filter(None, (str(JUPYTER), os.environ.get("JUPYTER_CONFIG_PATH"))))
    os.execve(sys.executable, words, {**os.environ, **KERNEL_ENVIRONMENT, "JUPYTER_CONFIG_PATH": settings})
