"""The `rover` command, called in this process."""

from pathlib import Path

from click.testing import CliRunner, Result

from rover_lib.cli import main


def rover(*words: object) -> Result:
    """Run `rover` with these words; its result has exit_code, output, stdout and stderr."""
    return CliRunner().invoke(main, [str(word) for word in words])


def programs(folder: Path, bodies: dict[str, str]) -> None:
    """Write shell scripts."""
    for name, body in bodies.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(f"#!/bin/sh\n{body}\n")
        (folder / name).chmod(0o755)
