"""Interrupt a training at a chosen call, with every step before it saved."""

from functools import partial
from typing import Any

import pytest

from rover_learn import training


def interrupt(patch: pytest.MonkeyPatch, owner: Any, name: str, at: int = 1) -> list[int]:
    """Let the at-th call of owner.name raise KeyboardInterrupt; all others are made. Returns a list that grows by one
    entry with each call.
    """
    calls: list[int] = []
    real = getattr(owner, name)

    def counted(*args, **options):
        calls.append(1)
        if len(calls) == at:
            raise KeyboardInterrupt
        return real(*args, **options)

    patch.setattr(owner, name, counted)
    return calls


def save_each_step(patch: pytest.MonkeyPatch, module: Any) -> None:
    """Let the trainings of `module` save after every step, however long that takes."""
    patch.setattr(module, "Resumable", partial(training.Resumable, every_s=0.0))
    patch.setattr(training, "SAVING_SHARE", 1e9)
