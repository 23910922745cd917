"""The commands of this package. `rover` has them by entry points of pyproject.toml."""

import os
import webbrowser
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import click

from rover_lib.cli.prepare import EPISODES, THROTTLE, size_option
from rover_lib.onboard.cli import AS_JSON, FILE, LOG_DRIVE, open_view, show, sum_up, view_options
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.kinds import Output, PathTo, check_kind
from rover_lib.workshop.progress import terminal_bar

SIZE = click.option(
    "--size", callback=size_option, metavar="WIDTHxHEIGHT", help="Size of the pictures [default: as recorded]."
)


@click.command("export-dataset", short_help="Write recordings, or a tub, as a LeRobotDataset v3.")
@click.argument("recordings", type=EPISODES)
@click.argument("out", type=FILE)
@SIZE
@THROTTLE
@AS_JSON
def export_dataset(recordings: Path, out: Path, throttle: str | None, as_json: bool, **options: Any) -> None:
    """Write our RECORDINGS, or donkeycar tubs, as a LeRobotDataset v3 to the new folder OUT, for lerobot-train.

    lerobot-train trains at the size of the pictures: at the recorded size it takes 25 times as long as with sides a
    fifth as long. On a GPU it waits for pictures unless lerobot-edit-dataset has made videos of them. What is repaired
    in the recordings or left out is printed, and kept in OUT/rover_export.json. In a drive of a policy, each frame says
    whether a human had taken over: LeRobot's `intervention`.

    A tub's steering and throttle become those of this machine's car (car.yml). Its deleted records and those at which a
    pilot drove are left out, and episodes end where records are missing.
    """
    from rover_exchange import export_dataset
    from rover_lib.workshop.recordings.source import Source

    source = Source.of(recordings, throttle=throttle or "")
    _print_export(export_dataset.export_dataset(source, out, progress=terminal_bar(), **options), out, as_json)


def _print_export(report: dict[str, Any], out: Path, as_json: bool) -> None:
    from rover_exchange.export_dataset import lerobot_train, lerobot_video
    from rover_lib.workshop.installed import command_line
    from rover_lib.workshop.recordings.lerobot_dataset import CAR, DRIVEN_BY, REPORT

    for name in ("episodes_are", "faults_while_reading", CAR, DRIVEN_BY):
        del report[name]  # too long to print; the file has them
    show({"exported": report | {"report": str(out / REPORT)}}, as_json)
    if not as_json:
        click.echo(f"next: {command_line('rover', 'train', out, 'best_model.pth')}")
        click.echo(f"or LeRobot's own: {lerobot_train(out)}")
        click.echo(f"on a GPU before that, which then trains on {out}-video: {lerobot_video(out)}")


@click.command(short_help="Show a drive in the browser, with a stop button.")
@click.argument("file", type=click.Path(path_type=Path, exists=True), required=False)
@view_options
def view(file: Path | None, **options: Any) -> None:
    """Show a drive in a browser: its picture, its plan, what the pins do. The page can stop the car and nothing else.

    Without FILE it shows the `rover drive` of this machine; an artifact drives through the balloon world. Whoever has
    the page's URL may look and stop; without --interface, only from this machine.
    """
    if file is None:
        return open_view(**options, opened=open_browser)
    check_kind(file, "artifact")
    (simulated,) = entry_points(group="rover.cars", name="world")
    open_view(**options, opened=open_browser, shown=simulated.load().shown(file))


def open_browser(url: str) -> None:
    """Open a browser if there is a screen; without one, a browser would take over the terminal."""
    if os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        webbrowser.open(url)


@click.command(short_help="Summarize a flight log, and draw it.")
@click.argument("file", type=PathTo("flight log"))
@click.option("-o", "--output", type=Output(), help="The figure to write [default: FILE.png].")
@LOG_DRIVE
@click.option("--video", type=Output(), help="A film of the drive, .mp4.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON; draw only with -o.")
def log(file: Path, output: Path | None, drive: int, video: Path | None, as_json: bool) -> None:
    """Summarize the flight log FILE of `rover drive`, and draw it.

    Older parts of the same log (FILE.1, FILE.2, ...) are read with it. The figure needs a workstation.

    --video makes a film of the drive instead: its pictures with the planned path, the commands and the servo pulses.
    It needs the pictures that `rover drive --record` has kept.
    """
    flight = sum_up(file, drive, as_json)
    if video:
        from rover_exchange.film import write_film

        count = write_film(video, flight, terminal_bar())
        click.echo(f"drawn: {video}, {count} pictures, {video.stat().st_size / 1e6:.2f} MB", err=as_json)
    if output or not (as_json or video):
        output = output or file.with_name(f"{file.name}.png")
        _draw(flight, output)
        click.echo(f"drawn: {output}", err=as_json)


def _draw(flight: Any, output: Path) -> None:
    """Write the figure of a drive. Raises RoverError for an ending that names no kind of figure."""
    from rover_exchange.flight import flight_figure
    from rover_lib.onboard.stage import atomic_path

    figure = flight_figure(flight)
    if output.suffix.lower()[1:] not in figure.canvas.get_supported_filetypes():
        actual = output.suffix or "no ending"
        raise RoverError(f"{output}: no figure has that ending", found=actual, remedy="use .png, .pdf or .svg")
    with atomic_path(output) as temporary:
        figure.savefig(temporary)
