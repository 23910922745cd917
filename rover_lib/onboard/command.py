"""What the commands of `rover` share: options, the printing of a result, and errors that end in one sentence."""

import functools
import json
import platform
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import click

from rover_lib.onboard.errors import RoverError, of_system, printable
from rover_lib.onboard.kinds import Number, PathTo

FILE = click.Path(path_type=Path)
ARTIFACT = PathTo("artifact")
MOST_THREADS = 256  # torch takes any number, and the process crashes where the system has no more
LONG_LIST = 12  # longer lists are for programs, and not printed for people
# Options that several commands share:
CAMERA = click.option("--camera", default="0", show_default=True, help="A number, /dev/videoN, csi or a FIFO.")
AS_JSON = click.option("--json", "as_json", is_flag=True, help="Print JSON.")
PORT = click.option("--port", default="", help="The Arduino's serial port [default: the only one that is there].")
LOG_DRIVE = click.option("--drive", type=int, default=-1, show_default=True, help="Of FILE: 0 the first, -1 the last.")
POSITIVE = Number(min=0, min_open=True)
FROM_0, FROM_1 = click.IntRange(min=0), click.IntRange(min=1)


class Rover(click.Group):
    """A group of commands in which a bad input ends in one sentence and exit code 1; --debug adds the traceback."""

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except BrokenPipeError:
            raise  # nobody reads any more: click ends without a word
        except (RoverError, OSError, MemoryError, ModuleNotFoundError) as error:
            ours = isinstance(error, ModuleNotFoundError) and (error.name or "").startswith("rover_lib")
            if ctx.params.get("debug") or ours:
                raise
            click.echo(f"rover: {_sentence_of(error)}", err=True)
        ctx.exit(1)


def _sentence_of(error: Exception) -> object:
    if isinstance(error, ModuleNotFoundError):
        remedy = "provision with -e rover_view=true" if error.name == "aiohttp" else "make demo sets a workstation up"
        return f"this command needs {error.name}; {remedy}"
    if isinstance(error, OSError):
        return of_system(error)
    return printable(str(error)) if isinstance(error, RoverError) else "out of memory: end other programs, or use less"


def show(value: Any, as_json: bool) -> None:
    """Print a nested dict for people, or as JSON."""
    from rover_lib.onboard.stage import plain

    value = plain(value)
    if as_json:
        click.echo(json.dumps(value, indent=2))
        return

    def lines(v: Any, indent: str) -> None:
        for key, inner in v.items() if isinstance(v, dict) else enumerate(v):
            if isinstance(inner, list) and len(inner) > LONG_LIST:
                click.echo(f"{indent}{key:<28} {len(inner)} values, see --json")
            elif isinstance(inner, (dict, list)) and inner:
                click.echo(f"{indent}{printable(key)}")
                lines(inner, indent + "  ")
            else:
                text = f"{inner:.4g}" if isinstance(inner, float) else printable(inner)
                click.echo(f"{indent}{printable(key):<28} {text}")

    lines(value, "")


def _print_versions(ctx: click.Context, _: click.Parameter, asked: bool) -> None:
    if asked and not ctx.resilient_parsing:
        from rover_lib.onboard.artifact.engines import PACKAGES
        from rover_lib.onboard.stage import version_of

        click.echo(f"rover {version_of('rover-policy') or 'not installed'}\nPython {platform.python_version()}")
        for engine, package in PACKAGES.items():  # of which none is imported
            version = (version_of(package) or "") if find_spec(package) else "is not installed"
            click.echo(f"engine {engine}: {package} {version}".rstrip())
        ctx.exit()


_FIRST: dict[str, Any] = {"is_flag": True, "is_eager": True, "expose_value": False}
VERSION = click.option("--version", **_FIRST, callback=_print_versions, help="Show versions, the engines' too.")


def with_options(*options: Callable) -> Callable[[Callable], Callable]:
    """Make one decorator of several options that more than one command has."""
    return lambda command: functools.reduce(lambda inner, option: option(inner), reversed(options), command)
