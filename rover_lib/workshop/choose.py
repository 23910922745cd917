"""Which observer, and which blocks stay in float: chosen by measuring, on frames that calibration has not seen.

    chooser = Chooser(checkpoint, calibration, samples, recordings.action_range())
    scheme, by_observer = chooser.observer(Scheme("static"))
    sensitivity = chooser.sensitivity(scheme)
    mixed, steps = chooser.mixed(scheme, sensitivity, budget_pct=0.2, max_cost_pct=5)

Errors are against FP32, in percent of each action's recorded range. An action that never changes in the recordings is
not judged: its error is None, and `warnings` says so.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from torch import Tensor, nn

from rover_lib.onboard.errors import QuantizeError
from rover_lib.workshop.act import ACT, blocks, inputs_of, multiply_accumulates, predictions
from rover_lib.workshop.checkpoint import Checkpoint
from rover_lib.workshop.episodes import Sample
from rover_lib.workshop.judge import Range, constant_actions, not_judged, pct_of_range, worst
from rover_lib.workshop.observe import Calibration, observed_graph
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.quantize import convert, quantize
from rover_lib.workshop.scheme import OBSERVERS, Scheme

Errors = dict[str, float | None]  # <action>_mae_pct, None where it is not judged
# A multiply-accumulate in float against one in INT8, in instructions: 6.08 to 1.44 G of the full policy, counted on an
# emulated Cortex-A76.
FLOAT_PER_INT8 = 4.2


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
        self, scheme: Scheme, sensitivity: Mapping[str, Errors], *, budget_pct: float, max_cost_pct: float
    ) -> tuple[Scheme, list[dict[str, Any]]]:
        """Leave blocks in float that take much of the error for few instructions, until every action is in the budget.

        Blocks are tried in the order of squared error taken per instruction added. One that is too dear for what is
        left of `max_cost_pct`, the instructions that mixed may have more than static, or after which the worse action
        is not better, stays INT8. Returns the mixed scheme and its steps {float_blocks, cost_pct, <action>_mae_pct},
        static first; the last is the best within the cost, in the budget or not.
        """
        graph = observed_graph(self.checkpoint, scheme, self.calibration)
        costs = float_costs_pct(self.checkpoint)
        order = sorted(sensitivity, key=lambda block: _worst(sensitivity[block]) ** 2 / costs[block], reverse=True)
        best = replace(scheme, mode="mixed", float_blocks=())
        cost, error = 0.0, self.error(convert(graph, self.checkpoint.config, best))
        steps: list[dict[str, Any]] = [{"float_blocks": [], "cost_pct": cost, **error}]
        for block in order:
            if _worst(error) <= budget_pct:
                break
            if cost + costs[block] > max_cost_pct or len(best.float_blocks) == len(sensitivity) - 1:
                continue
            trial = replace(best, float_blocks=(*best.float_blocks, block))
            found = self.error(convert(graph, self.checkpoint.config, trial))
            if _worst(found) < _worst(error):
                best, cost, error = trial, cost + costs[block], found
                steps.append({"float_blocks": list(best.float_blocks), "cost_pct": cost, **error})
        return best, steps


def float_costs_pct(checkpoint: Checkpoint) -> dict[str, float]:
    """What each block adds to the instructions of static INT8 when it is left in float, in percent; computed."""
    macs = multiply_accumulates(ACT(checkpoint.config, checkpoint.weights))
    whole = sum(macs.values())
    return {block: 100 * (FLOAT_PER_INT8 - 1) * macs[block] / whole for block in blocks(checkpoint.config)}


def _worst(errors: Errors) -> float:
    largest = worst(errors)
    assert largest is not None  # a Chooser has an action to judge
    return largest
