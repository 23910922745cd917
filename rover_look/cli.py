"""The commands that show and draw drives. `rover` has them by entry points of pyproject.toml."""

import os
import webbrowser
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import click

from rover_lib.onboard.cli import LOG_DRIVE, open_view, sum_up, view_options
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.kinds import Number, Output, PathTo, check_kind, kinds_of


@click.command(short_help="Show a drive in the browser, with a stop button.")
@click.argument("file", type=click.Path(path_type=Path, exists=True), required=False)
@view_options
@LOG_DRIVE
def view(file: Path | None, drive: int, **options: Any) -> None:
    """Show a drive in a browser: its picture, its plan, what the pins do. The page can stop the car and nothing else.

    Without FILE it shows the `rover drive` of this machine, which may come and go. If FILE is an artifact, it drives
    through the balloon world; the drive in a flight log or a recording is shown again.

    Whoever has the page's URL may look and stop; without --interface, only from this machine.
    """
    if file is None:
        return open_view(**options, opened=open_browser)
    if {"flight log", "recordings"} & set(kinds_of(file)):
        from rover_look.replay import load_replay

        return open_view(**options, opened=open_browser, shown=load_replay(file, drive))
    check_kind(file, "artifact")
    (simulated,) = entry_points(group="rover.cars", name="world")
    open_view(**options, opened=open_browser, shown=simulated.load().shown(file))


@click.command(short_help="Summarize a flight log, and draw it.")
@click.argument("file", type=PathTo("flight log"))
@click.option("-o", "--output", type=Output(), help="The figure to write [default: FILE.png].")
@LOG_DRIVE
@click.option("--video", type=Output(), help="A film of the drive: .mp4, or .webp for a page.")
@click.option("--mcap", type=Output(), help="The drive for Foxglove or Rerun, with its pictures if it was recorded.")
@click.option(
    "--pictures", type=PathTo("recordings"), help="The drive's episode [default: the one that the log names]."
)
@click.option("--video-hz", type=Number(1, 60), default=30, show_default=True, help="Pictures a second of the film.")
@click.option(
    "--video-width", type=click.IntRange(160, 1920), default=640, show_default=True, help="Width of the film in pixels."
)
@click.option("--json", "as_json", is_flag=True, help="Print JSON; draw only with -o.")
def log(
    file: Path,
    output: Path | None,
    drive: int,
    video: Path | None,
    mcap: Path | None,
    pictures: Path | None,
    video_hz: float,
    video_width: int,
    as_json: bool,
) -> None:
    """Summarize the flight log FILE of `rover drive`, and draw it.

    The summary has missed ticks, jitter, ages and latencies of plans, who drove, temperature and events. Older parts
    of the same log (FILE.1, FILE.2, ...) are read with it. The figure needs a workstation, the summary does not.

    --video makes a film of the drive instead: its pictures with the planned path, the commands and the servo pulses.
    It needs the pictures that `rover drive --record` has kept. --mcap writes the log, with the pictures if there are
    any, for viewers of MCAP files.
    """
    flight = sum_up(file, drive, as_json)
    if video:
        from rover_lib.workshop.progress import terminal_bar
        from rover_look.film import write_film
        from rover_look.replay import load_replay

        shown = load_replay(file, drive, pictures)
        width = video_width // 2 * 2
        count = write_film(video, shown, rate_hz=video_hz, width=width, progress=terminal_bar())
        click.echo(f"drawn: {video}, {count} pictures, {video.stat().st_size / 1e6:.2f} MB", err=as_json)
    if mcap:
        from rover_look.mcap_log import write_mcap

        counts = write_mcap(mcap, flight, pictures)
        said = ", ".join(f"{count} of {topic}" for topic, count in counts.items())
        click.echo(f"written: {mcap}, {said}, {mcap.stat().st_size / 1e6:.2f} MB", err=as_json)
    if output or not (as_json or video or mcap):
        from rover_lib.onboard.stage import atomic_path
        from rover_look.flight import flight_figure

        output = output or file.with_name(f"{file.name}.png")
        figure = flight_figure(flight)
        if output.suffix.lower()[1:] not in figure.canvas.get_supported_filetypes():
            found = output.suffix or "no ending"
            raise RoverError(f"{output}: no figure has that ending", found=found, remedy="say .png, .pdf or .svg")
        with atomic_path(output) as temporary:
            figure.savefig(temporary)
        click.echo(f"drawn: {output}", err=as_json)


def open_browser(url: str) -> None:
    """Open a browser if there is a screen; without one, a browser would take over the terminal."""
    if os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        webbrowser.open(url)
