"""Commands for driving on a workstation, also in the balloon world, and for showing and drawing drives."""

from functools import partial
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import click

from rover_lib.onboard.cli import LOG_DRIVE, drive_options, open_view, run_drive, sum_up, view_options
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.kinds import Number, Output, PathTo


@click.command(short_help="Drive a car, or in the balloon world, with an artifact.")
@drive_options
@click.option("--world", "in_world", is_flag=True, help="Drive in the balloon world instead of a car, in real time.")
@click.option("--latency-ms", type=Number(min=0), default=0, help="With --world: minimum time of a plan.")
@click.option(
    "--seed",
    type=click.IntRange(min=0),
    default=10_000,
    show_default=True,
    help="With --world: seed of the first world.",
)
@click.pass_context
def drive(ctx: click.Context, in_world: bool, latency_ms: float, seed: int, **options: Any) -> None:
    """Drive by ARTIFACT: arm the car once camera, plan and Arduino are ready, and stop it whatever fails.

    Exit codes: 0 ended as asked (--ticks, --max-seconds, end of --replay, SIGINT, SIGTERM, SIGHUP, SIGQUIT); 1 could
    not begin; 2 usage; 3 a fault stopped the car; 4 the human took over. Only another start arms it again; with
    --service, which waits disarmed after each drive, another request does.
    """
    if latency_ms and not in_world:
        raise click.UsageError("--latency-ms belongs to --world")
    car = None
    if in_world:
        (simulated,) = entry_points(group="rover.cars", name="world")
        car = partial(simulated.load(), seed=seed)
    ctx.exit(run_drive(car=car, latency_ms=latency_ms, **options))


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
    from rover_lib.cli import watching

    if file is None:
        return open_view(**options, opened=watching.open_browser)
    watching.watch(file, drive, options)


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
        from rover_lib.workshop.drive_log.film import write_film
        from rover_lib.workshop.drive_log.replay import load_replay
        from rover_lib.workshop.progress import terminal_bar

        shown = load_replay(file, drive, pictures)
        width = video_width // 2 * 2
        count = write_film(video, shown, rate_hz=video_hz, width=width, progress=terminal_bar())
        click.echo(f"drawn: {video}, {count} pictures, {video.stat().st_size / 1e6:.2f} MB", err=as_json)
    if mcap:
        from rover_lib.workshop.drive_log.mcap_log import write_mcap

        counts = write_mcap(mcap, flight, pictures)
        said = ", ".join(f"{count} of {topic}" for topic, count in counts.items())
        click.echo(f"written: {mcap}, {said}, {mcap.stat().st_size / 1e6:.2f} MB", err=as_json)
    if output or not (as_json or video or mcap):
        from rover_lib.onboard.stage import atomic_path
        from rover_lib.workshop.drive_log.flight import flight_figure

        output = output or file.with_name(f"{file.name}.png")
        figure = flight_figure(flight)
        if output.suffix.lower()[1:] not in figure.canvas.get_supported_filetypes():
            found = output.suffix or "no ending"
            raise RoverError(f"{output}: no figure has that ending", found=found, remedy="say .png, .pdf or .svg")
        with atomic_path(output) as temporary:
            figure.savefig(temporary)
        click.echo(f"drawn: {output}", err=as_json)
