"""Which observer, and which blocks stay in float: chosen by measuring, on frames that calibration has not seen.

    chooser = Chooser(checkpoint, calibration, samples, recordings.action_range())
    scheme, by_observer = chooser.observer(Scheme("static"))
    sensitivity = chooser.sensitivity(scheme)
    mixed, steps = chooser.mixed(scheme, sensitivity, budget_pct=0.2, max_blocks=4)

Errors are against FP32, in percent of each action's recorded range. An action that never changes in the recordings is
not judged: its error is None, and `warnings` says so.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from torch import Tensor, nn

from rover_lib.onboard.errors import QuantizeError
from rover_lib.workshop.act import ACT, blocks, inputs_of, predictions
from rover_lib.workshop.checkpoint import Checkpoint
from rover_lib.workshop.episodes import Sample
from rover_lib.workshop.judge import Range, constant_actions, not_judged, pct_of_range, worst
from rover_lib.workshop.observe import Calibration, observed_graph
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.quantize import convert, quantize
from rover_lib.workshop.scheme import OBSERVERS, Scheme

Errors = dict[str, float | None]  # <action>_mae_pct, None where it is not judged


def mae_pct(actions: Tensor, reference: Tensor, action_range: Mapping[str, Range]) -> Errors:
    """Mean absolute difference per action, in percent of the recorded range, as {<action>_mae_pct: value}."""
    error = (actions - reference).abs().mean((0, 1))
    return {
        f"{name}_mae_pct": pct_of_range(e.item(), recorded)
        for (name, recorded), e in zip(action_range.items(), error, strict=True)
    }


class Chooser:
    """The float policy and its answers on a few samples, prepared once for many conversions.

    warnings: a sentence for each action that is not judged. Raises QuantizeError without samples, and where no action
    changes in the recordings.
    """

    def __init__(
        self,
        checkpoint: Checkpoint,
        calibration: Calibration,
        samples: Sequence[Sample],
        action_range: Mapping[str, Range],
    ):
        if not samples:
            raise QuantizeError(
                "choosing needs samples that calibration has not seen", found="none", remedy="record more episodes"
            )
        if len(constant_actions(action_range)) == len(action_range):
            raise QuantizeError(
                f"{' and '.join(action_range)} never change in these recordings: no error can be judged",
                remedy="record episodes in which the car is steered",
            )
        self.checkpoint, self.calibration, self.action_range = checkpoint, calibration, action_range
        self.warnings = not_judged(action_range)
        self.inputs = [inputs_of(s, checkpoint.config) for s in samples]
        self.reference = predictions(ACT(checkpoint.config, checkpoint.weights), self.inputs)

    def error(self, module: nn.Module) -> Errors:
        """Of a quantized policy, against FP32 on the samples."""
        return mae_pct(predictions(module, self.inputs), self.reference, self.action_range)

    def observer(
        self, scheme: Scheme, observers: Sequence[str] = OBSERVERS, progress: Progress = silent
    ) -> tuple[Scheme, dict[str, Errors]]:
        """Quantize with each observer; the one whose worse action has the least error wins."""
        table = {}
        for name in progress(observers, desc="observers"):
            module = quantize(self.checkpoint, replace(scheme, observer=name), self.calibration).module
            table[name] = self.error(module)
        best = min(table, key=lambda name: _worst(table[name]))
        return replace(scheme, observer=best), table

    def sensitivity(self, scheme: Scheme, progress: Progress = silent) -> dict[str, Errors]:
        """Each block quantized alone, everything else in float: {block: errors}."""
        graph = observed_graph(self.checkpoint, scheme, self.calibration)
        config = self.checkpoint.config
        table = {}
        for block in progress(blocks(config), desc="blocks"):
            table[block] = self.error(convert(graph, config, replace(scheme, float_blocks=()), only=[block]))
        return table

    def mixed(
        self, scheme: Scheme, sensitivity: Mapping[str, Errors], *, budget_pct: float, max_blocks: int
    ) -> tuple[Scheme, list[dict[str, Any]]]:
        """Leave the most sensitive blocks in float, one more at a time, until every action's error is in the budget.

        Returns the mixed scheme and each step {float_blocks, <action>_mae_pct}; if `max_blocks` do not reach the
        budget, the best step is taken and the last one shows it.
        """
        graph = observed_graph(self.checkpoint, scheme, self.calibration)
        order = sorted(sensitivity, key=lambda block: _worst(sensitivity[block]), reverse=True)
        trials: list[tuple[Scheme, Errors]] = []
        for count in range(min(max_blocks, len(order) - 1) + 1):
            trial = replace(scheme, mode="mixed", float_blocks=tuple(order[:count]))
            trials.append((trial, self.error(convert(graph, self.checkpoint.config, trial))))
            if _worst(trials[-1][1]) <= budget_pct:
                break
        best, _ = min(trials, key=lambda t: max(_worst(t[1]), budget_pct))
        return best, [{"float_blocks": list(trial.float_blocks), **error} for trial, error in trials]


def _worst(errors: Errors) -> float:
    largest = worst(errors)
    assert largest is not None  # a Chooser has an action to judge
    return largest
