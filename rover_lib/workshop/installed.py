"""How the project is installed here: its files that are no modules, and commands as they work in the user's shell.

notebooks/, ansible/ and others stand at the top of the repository. The build puts them into the wheel's
rover_lib/shipped (pyproject.toml, force-include).
"""

import os
import shlex
import shutil
import sys
from pathlib import Path

PACKAGE = Path(__file__).parents[1]
IN_WHEEL = (PACKAGE / "shipped").is_dir()
SHIPPED = PACKAGE / "shipped" if IN_WHEEL else PACKAGE.parent


def command_line(*words: object) -> str:
    """A command to print: typed as it stands, it works in this shell, also with spaces in names."""
    return typed(shlex.join(str(word) for word in words))


def typed(command: str) -> str:
    """A command as it works in this shell: a program of this environment that is not on PATH gets its folder."""
    program, space, rest = command.partition(" ")
    program_path = Path(sys.executable).with_name(program)
    if shutil.which(program) or not program_path.is_file():
        return command
    return f"{shlex.quote(relative(program_path))}{space}{rest}"


def relative(path: Path | str) -> str:
    """A path as it would be typed here: relative where it is below this folder."""
    path = Path(path)
    return os.path.relpath(path) if path.is_absolute() and path.is_relative_to(Path.cwd()) else str(path)
