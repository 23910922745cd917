"""Driving on a workstation, also in the balloon world."""

from functools import partial
from importlib.metadata import entry_points
from typing import Any

import click

from rover_lib.onboard import cli as onboard
from rover_lib.onboard.command import FROM_0
from rover_lib.onboard.kinds import Number


@click.command(help=onboard.drive.help, short_help="Drive a car, or in the balloon world, with an artifact.")
@onboard.drive_options
@click.option("--world", "in_world", is_flag=True, help="Drive in the balloon world instead of a car, in real time.")
@click.option("--latency-ms", type=Number(min=0), default=0, help="With --world: minimum time of a plan.")
@click.option("--seed", type=FROM_0, default=10_000, show_default=True, help="With --world: seed of the first world.")
@click.pass_context
def drive(ctx: click.Context, in_world: bool, latency_ms: float, seed: int, **options: Any) -> None:
    if latency_ms and not in_world:
        raise click.UsageError("--latency-ms belongs to --world")
    car = None
    if in_world:
        (simulated,) = entry_points(group="rover.cars", name="world")
        car = partial(simulated.load(), seed=seed)
    ctx.exit(onboard.run_drive(car=car, latency_ms=latency_ms, **options))
