"""How a training went: its losses and held-out errors as JSON, as a figure, and as TensorBoard's files."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from rover_lib.workshop.plots.style import new_figure

POINTS = 200  # of a phase's losses in the figure: each is the mean of those around it


def leave_curves(
    stem: Path, losses: Mapping[str, Sequence[float]], errors: Mapping[str, Sequence[Sequence[float]]]
) -> None:
    """Write <stem>.json and <stem>.png, and the folder <stem>-tensorboard if TensorBoard is installed.

    losses: of each step, by phase. errors: [step, held-out error], by phase.
    """
    losses = {phase: values for phase, values in losses.items() if values}
    Path(f"{stem}.json").write_text(json.dumps({"losses": losses, "errors": errors}) + "\n")
    figure, (axes,) = new_figure(1, max(len(losses), 1))
    for ax, (phase, values) in zip(axes, losses.items(), strict=False):
        parts = np.array_split(np.arange(len(values)), min(len(values), POINTS))
        ax.plot([part.mean() for part in parts], [np.take(values, part).mean() for part in parts], label="loss")
        if judged := errors.get(phase):
            ax.plot(*zip(*judged, strict=True), "o-", label="held-out error")
        ax.set(title=phase, xlabel="step", yscale="log")
        ax.legend()
    axes[0].set_ylabel("loss, error")
    figure.savefig(f"{stem}.png")
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return
    with SummaryWriter(f"{stem}-tensorboard") as writer:
        for phase, values in losses.items():
            for step, value in enumerate(values):
                writer.add_scalar(f"loss/{phase}", value, step)
            for at, error in errors.get(phase, ()):
                writer.add_scalar(f"held-out error/{phase}", error, int(at))
