"""The `rover` command, called in this process."""

from click.testing import CliRunner, Result

from rover_lib.cli import main


def rover(*words: object) -> Result:
    """Run `rover` with these words; its result has exit_code, output, stdout and stderr."""
    return CliRunner().invoke(main, [str(word) for word in words])
