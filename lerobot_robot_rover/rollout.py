"""Refuse what `lerobot-rollout` would do to a car: it is made for arms, which can return to a position, and hold it."""

import sys
from typing import Any

from rover_lib.onboard.errors import ParamsError


def find_rollout() -> Any:
    """Return the config of the `lerobot-rollout` that calls this, by the callers' variables; None in other commands."""
    frame = sys._getframe(1)
    while frame:
        if type(config := frame.f_locals.get("cfg")).__name__ == "RolloutConfig":
            return config
        frame = frame.f_back  # type: ignore[assignment]  # None at the outermost
    return None


def check_rollout(config: Any) -> None:
    """Raise ParamsError for what a car cannot take, with all options that must be given. config: of find_rollout."""
    strategy = config.strategy
    options = []
    if type(strategy).__name__ == "DAggerStrategyConfig":  # its pause repeats an action, by which a car drives on
        raise ParamsError("DAgger's pause would drive a car on", remedy="record takeovers: rover drive --record")
    if config.interpolation_multiplier != 1:  # the robot waits for a new picture each time: a plan would last longer
        options.append("--interpolation_multiplier=1")
    if config.teleop is not None and getattr(strategy, "smooth_handover", False):  # drives from one action to another
        options.append("--strategy.smooth_handover=false")
    if config.teleop is None and getattr(strategy, "reset_to_initial_position", False):
        options.append("--strategy.reset_to_initial_position=false")
    if options:
        raise ParamsError("lerobot-rollout would move this car as an arm", remedy=" ".join(options))
