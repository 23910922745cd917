"""The commands that exchange recordings. `rover` has them by entry points of pyproject.toml."""

from pathlib import Path
from typing import Any

import click

from rover_lib.cli.prepare import EPISODES, size_option
from rover_lib.onboard.cli import AS_JSON, FILE, show
from rover_lib.onboard.kinds import PathTo
from rover_lib.workshop.progress import terminal_bar


@click.command("export-dataset", short_help="Write recordings as a LeRobotDataset v3.")
@click.argument("episodes", type=EPISODES)
@click.argument("out", type=FILE)
@click.option("--video", is_flag=True, help="Write AV1 video: far smaller than images, but lossy [default: images].")
@click.option(
    "--size", callback=size_option, metavar="WIDTHxHEIGHT", help="Size of the pictures [default: as recorded]."
)
@AS_JSON
def export_dataset(episodes: Path, out: Path, as_json: bool, **options: Any) -> None:
    """Write our recordings in EPISODES as a LeRobotDataset v3 to the new folder OUT, for lerobot-train.

    lerobot-train trains at the size of the pictures: at the recorded size it takes 25 times as long as with sides a
    fifth as long. What is repaired in the recordings or left out is printed, and kept in OUT/rover_export.json. In a
    drive of a policy, each frame says whether a human had taken over: LeRobot's `intervention`.
    """
    from rover_exchange.export_dataset import export_dataset as write

    report = write(episodes, out, progress=terminal_bar(), **options)
    _say_export(report, out, "exported", as_json)


def _say_export(report: dict[str, Any], out: Path, done: str, as_json: bool) -> None:
    from rover_exchange.export_dataset import CAR, DRIVEN_BY, OUTCOMES, REPORT
    from rover_lib.workshop.recordings.lerobot_dataset import lerobot_train

    for name in ("episodes_are", "faults_while_reading", CAR, DRIVEN_BY, OUTCOMES):
        del report[name]  # too long to print; the file has them
    show({done: report | {"report": str(out / REPORT)}}, as_json)
    if not as_json:
        from rover_lib.onboard.artifact.acceptance import Expected

        if (frames := report["frames_in_a_usual_episode"]) < Expected.chunk:
            click.echo(
                f"half of its episodes have at most {frames} frames, a plan {Expected.chunk}: its drives have holes"
            )
        click.echo(f"next: rover train {out} best_model.pth\nor LeRobot's own: {lerobot_train(out)}")


@click.command("import", short_help="Write a donkeycar tub as a LeRobotDataset v3.")
@click.argument("tub", type=PathTo("tub"))
@click.argument("out", type=FILE)
@click.option(
    "--size", callback=size_option, metavar="WIDTHxHEIGHT", help="Size of the pictures [default: as recorded]."
)
@click.option("--throttle", type=click.Choice(["as-recorded", "negated"]), help="For a car that drives forward by < 0.")
@AS_JSON
def import_tub(tub: Path, out: Path, size: tuple[int, int] | None, throttle: str | None, as_json: bool) -> None:
    """Write the donkeycar tub in the folder TUB, of any age, as a LeRobotDataset v3 to the new folder OUT.

    Steering and throttle become those of this machine's car (car.yml). Deleted records and those at which a pilot drove
    are left out, and episodes end where records are missing. What was left out is printed, and kept in
    OUT/rover_export.json.
    """
    from rover_exchange.export_dataset import export_dataset as write
    from rover_exchange.tub import read_tub
    from rover_lib.onboard.car.car import this_car

    report = write(read_tub(tub, this_car(), terminal_bar(), throttle), out, size=size, progress=terminal_bar())
    _say_export(report, out, "imported", as_json)
