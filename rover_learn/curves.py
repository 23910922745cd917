"""How a training went: its losses and held-out errors as JSON, as a figure, and as TensorBoard's files."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from rover_lib.workshop.plots.style import new_figure


def leave_curves(
    folder: Path, losses: Mapping[str, Sequence[float]], errors: Mapping[str, Sequence[Sequence[float]]]
) -> None:
    """Write curves.json and curves.png into a new folder, and TensorBoard's files if that is installed.

    losses: of each step, by phase. errors: [step, held-out error], by phase.
    """
    folder.mkdir()
    losses = {phase: values for phase, values in losses.items() if values}
    (folder / "curves.json").write_text(json.dumps({"losses": losses, "errors": errors}) + "\n")
    figure, (axes,) = new_figure(1, max(len(losses), 1))
    for ax, (phase, values) in zip(axes, losses.items(), strict=False):
        ax.plot(values, label="loss")
        if judged := errors.get(phase):
            ax.plot(*zip(*judged, strict=True), "o-", label="held-out error")
        ax.set(title=phase, xlabel="step", yscale="log")
        ax.legend()
    axes[0].set_ylabel("loss, error")
    figure.savefig(folder / "curves.png")
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return
    with SummaryWriter(str(folder)) as writer:
        for phase, values in losses.items():
            for name, points in (("loss", enumerate(values)), ("held-out error", errors.get(phase, ()))):
                for step, value in points:
                    writer.add_scalar(f"{name}/{phase}", value, int(step))
