"""Which observer, and which blocks stay in float: chosen by measuring, on frames that calibration has not seen.

    chooser = Chooser(checkpoint, calibration, samples, recordings.action_range())
    scheme, by_observer = chooser.observer(Scheme("static"))
    sensitivity = chooser.sensitivity(scheme)
    mixed, steps = chooser.mixed(scheme, sensitivity, budget_pct=0.2, max_cost_pct=5)

Errors are against FP32, in percent of each action's recorded range; None for an action that never changes there.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn
from torch.fx import GraphModule

from rover_lib.onboard.errors import ArtifactError
from rover_lib.workshop.act import ACT, blocks, inputs_of, multiply_accumulates, predictions
from rover_lib.workshop.checkpoint.checkpoint import Checkpoint
from rover_lib.workshop.int8.frames import ODD, odd_share, usual
from rover_lib.workshop.int8.observe import Calibration, restore_observed, set_ranges, times_of
from rover_lib.workshop.int8.quantize import convert, forget_graphs
from rover_lib.workshop.int8.scheme import OBSERVERS, Scheme
from rover_lib.workshop.judge.recorded_range import Range, constant_actions, not_judged, pct_of_range, worst
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings.samples import Sample, pick_evenly

Errors = dict[str, float | None]  # <action>_mae_pct, None where it is not judged
# A multiply-accumulate in float against one in INT8, in instructions: 6.08 to 1.44 G of the full policy, counted on an
# emulated Cortex-A76.
FLOAT_PER_INT8 = 4.2
# Min-max clips nothing that calibration saw. On a few frames others often seem a little better, and on frames of other
# episodes they were up to twice as bad. So what clips more must have less than this times the error:
CLIPPING_PAYS = 0.8
SENSITIVITY_FRAMES = 16  # of the choosing frames: they only order the blocks, which are then tried on all
MIXED_PAYS = 0.9  # mixed must have less than this times the error of static, or it is static
USUAL_PCT = (99, 95, 90, 75, 50)  # tried by the observer `frames`, if there are odd frames
# Where odd frames are far above the others in every tensor, widening one range mends nothing while the next one clips.
# So all but the odd frames are also tried with every range wider, by these shares:
ALL_WIDER = (0.9, 0.8, 0.7, 0.5, 0.3)
# Then the ranges of the tensors whose odd frames reach furthest are widened by WIDER of the way at a time, if the error
# is at most WIDENING_PAYS times what it was, and that of usual frames WIDENING_COSTS times what it was without any.
WIDENED = 8
WIDER = 0.2
WIDENING_PAYS = 0.99
WIDENING_COSTS = 1.1
WIDENING_ROUNDS = 3


def mae_pct(errors: Tensor, weights: Tensor, action_range: Mapping[str, Range]) -> Errors:
    """Weighted mean of (frames, actions) errors, in percent of the recorded range, as {<action>_mae_pct: value}."""
    error = (weights[:, None] * errors).sum(0) / weights.sum()
    errors_pct = {}
    for (name, recorded), of_action in zip(action_range.items(), error, strict=True):
        errors_pct[f"{name}_mae_pct"] = pct_of_range(of_action.item(), recorded)
    return errors_pct


class Chooser:
    """The float policy and its answers on a few samples, prepared once for many conversions.

    odd: some of the odd frames that calibration met. With the odd ones among the samples they weigh in every error what
    odd frames weigh in the recordings: their share of what calibration saw, or of the samples, if that is larger.
    Raises ArtifactError without samples, and where no action changes in the recordings.
    """

    def __init__(
        self,
        checkpoint: Checkpoint,
        calibration: Calibration,
        samples: Sequence[Sample],
        action_range: Mapping[str, Range],
        odd: Sequence[Sample] = (),
    ):
        if not samples:
            raise ArtifactError("choosing needs samples that did not calibrate", remedy="record more episodes")
        if len(constant_actions(action_range)) == len(action_range):
            raise ArtifactError("no action changes in these recordings", remedy="record episodes with steering")
        forget_graphs()  # for the first time, as nothing is converted yet
        self.checkpoint = checkpoint
        self.calibration = calibration
        self.action_range = action_range
        self.warnings = not_judged(action_range)
        self.inputs = [inputs_of(s, checkpoint.config) for s in (*samples, *odd)]
        self.reference = predictions(ACT(checkpoint.config, checkpoint.weights), self.inputs)
        self.is_odd = torch.arange(len(self.inputs)) >= len(samples)
        self.weights = torch.ones(len(self.inputs))
        if odd:
            graph = self._observed(Scheme(smooth=calibration.smooth))
            unseen = times_of(graph, calibration, self.inputs[: len(samples)]) > ODD
            self.is_odd[: len(samples)] = unseen
            share = max(odd_share(calibration.frames), unseen.float().mean().item())
            for of_all, kind in ((1 - share, ~self.is_odd), (share, self.is_odd)):
                self.weights[kind] = of_all * len(kind) / kind.sum().clamp(min=1)

    def _observed(self, scheme: Scheme) -> GraphModule:
        return restore_observed(self.checkpoint, scheme, self.calibration)

    def errors(self, module: nn.Module, some: Sequence[int] | None = None) -> Tensor:
        """(frames, actions): each frame's mean absolute difference to its plan in FP32. some: of these frames only."""
        forget_graphs()
        of = list(range(len(self.inputs))) if some is None else list(some)
        actions = predictions(module, [self.inputs[i] for i in of])
        return (actions - self.reference[of]).abs().mean(1)

    def error(self, module: nn.Module) -> Errors:
        """The errors of a quantized policy against FP32, in % of the recorded range."""
        return mae_pct(self.errors(module), self.weights, self.action_range)

    def error_by_kind(self, module: nn.Module) -> dict[str, Errors]:
        """The same on usual and on odd frames, of the kinds that there are."""
        errors = self.errors(module)
        kinds = {"usual": ~self.is_odd, "odd": self.is_odd}
        there = {name: kind for name, kind in kinds.items() if kind.any()}
        return {name: mae_pct(errors[kind], kind[kind].float(), self.action_range) for name, kind in there.items()}

    def observer(
        self, scheme: Scheme, observers: Sequence[str] = OBSERVERS, progress: Progress = silent
    ) -> tuple[Scheme, dict[str, Errors]]:
        """Quantize with each observer, `frames` only where there are odd frames; return the best scheme, all errors."""
        tried = self._candidates(scheme, observers)
        graph = self._observed(scheme)

        def judge(trial: Scheme) -> Tensor:
            set_ranges(graph, trial, self.calibration)
            return self.errors(convert(graph, self.checkpoint.config, scheme))

        table = {}
        for name in progress(tried, desc="observers"):
            table[name] = mae_pct(judge(tried[name]), self.weights, self.action_range)
        best = best_of(tried, table)
        if tried[best].observer != "frames":
            return tried[best], table
        best_scheme, table[f"{best}, widened"] = self._widen(tried[best], judge, progress)
        return best_scheme, table

    def _candidates(self, scheme: Scheme, observers: Sequence[str]) -> dict[str, Scheme]:
        tried = {name: replace(scheme, observer=name) for name in observers if name != "frames"}
        if "frames" in observers and (share := odd_share(self.calibration.frames)):
            frames = replace(scheme, observer="frames", usual_pct=round(100 * (1 - share), 1))
            for pct in sorted({*USUAL_PCT, frames.usual_pct}, reverse=True):
                tried[f"frames {pct:g}"] = replace(frames, usual_pct=pct)
            for by in ALL_WIDER:
                wider = tuple((place, by) for place in self.calibration.frames)
                tried[f"frames {frames.usual_pct:g}, all {by:g} wider"] = replace(frames, wider=wider)
        return tried

    def _widen(self, scheme: Scheme, errors: Callable[[Scheme], Tensor], progress: Progress) -> tuple[Scheme, Errors]:
        """Let the tensors whose odd frames reach furthest reach further, one step at a time, while all frames gain."""
        frames = self.calibration.frames
        usual_frames = usual(frames, scheme.usual_pct)
        further = {}
        for place, extremes in frames.items():
            further[place] = extremes.abs().max() / extremes[usual_frames].abs().max().clamp(min=1e-6)
        places = sorted(further, key=lambda place: -further[place])[:WIDENED]

        def judge(scheme: Scheme) -> tuple[Errors, float]:
            errors_found = errors(scheme)
            of_usual = mae_pct(errors_found, self.weights * ~self.is_odd, self.action_range)
            return mae_pct(errors_found, self.weights, self.action_range), _worst(of_usual)

        error, usually = judge(scheme)
        best = scheme
        wider = dict(scheme.wider)
        touched = set[str]()
        for step in progress(range(WIDENING_ROUNDS), desc="widening"):
            for place in (p for p in places if not step or p in touched):
                more = wider | {place: min(wider.get(place, 0.0) + WIDER, 1.0)}
                trial = replace(scheme, wider=tuple(more.items()))
                actual, of_usual = judge(trial)
                if _worst(actual) <= WIDENING_PAYS * _worst(error) and of_usual <= WIDENING_COSTS * usually:
                    best = trial
                    wider = more
                    error = actual
                    touched.add(place)
        return best, error

    def sensitivity(self, scheme: Scheme, progress: Progress = silent) -> dict[str, Errors]:
        """Each block quantized alone, everything else in float: {block: errors}."""
        graph = self._observed(scheme)
        config = self.checkpoint.config
        plain = replace(scheme, float_blocks=())
        some = list(pick_evenly(range(len(self.inputs)), SENSITIVITY_FRAMES))
        table = {}
        for block in progress(blocks(config), desc="blocks"):
            errors = self.errors(convert(graph, config, plain, only=[block]), some)
            table[block] = mae_pct(errors, self.weights[some], self.action_range)
        return table

    def mixed(
        self,
        scheme: Scheme,
        sensitivity: Mapping[str, Errors],
        *,
        budget_pct: float,
        max_cost_pct: float,
        blocks: Sequence[str] | None = None,
    ) -> tuple[Scheme, list[dict[str, Any]]]:
        """Leave blocks in float that take much of the error for few instructions, until every action is in the budget.

        Blocks are tried in the order of squared error taken per instruction added. One that costs more than is left of
        `max_cost_pct` of static's instructions, or that does not help the worse action, stays INT8. blocks: leave these
        in float instead, whatever they cost. Blocks that gain nothing stay INT8, with a warning. Returns the mixed
        scheme and its steps {float_blocks, cost_pct, <action>_mae_pct}, static first, the best last. Raises
        ArtifactError for an unknown block.
        """
        graph = self._observed(scheme)
        costs = float_costs_pct(self.checkpoint)
        best = replace(scheme, mode="mixed", float_blocks=())

        def step(*in_float: str) -> dict[str, Any]:
            trial = replace(best, float_blocks=in_float)
            errors = self.error(convert(graph, self.checkpoint.config, trial))
            cost_pct = sum((costs[block] for block in in_float), 0.0)
            return {"float_blocks": list(in_float), "cost_pct": cost_pct, **errors}

        steps = [step()] if blocks is None else [step(), step(*blocks)]
        order = sorted(sensitivity, key=lambda block: _worst(sensitivity[block]) ** 2 / costs[block], reverse=True)
        for block in order if blocks is None else ():
            last = steps[-1]
            if _worst(last) <= budget_pct:
                break
            if last["cost_pct"] + costs[block] > max_cost_pct or len(last["float_blocks"]) == len(sensitivity) - 1:
                continue
            trial = step(*last["float_blocks"], block)
            if _worst(trial) < _worst(last):
                steps.append(trial)
        before = _worst(steps[0])
        after = _worst(steps[-1])
        if blocks is None and len(steps) > 1 and after > MIXED_PAYS * before:
            in_float = ", ".join(steps[-1]["float_blocks"])
            self.warnings.append(f"mixed gains nothing by {in_float} in float: {before:.3f} to {after:.3f} %")
            steps = steps[:1]
        return replace(best, float_blocks=tuple(steps[-1]["float_blocks"])), steps


def best_of(tried: Mapping[str, Scheme], table: Mapping[str, Errors]) -> str:
    """The name whose worse action has the least error, unless it clips more than another and does not win clearly."""
    best = min(table, key=lambda name: _worst(table[name]))
    for name, result in tried.items():  # of these, what clips less comes first
        rival = result.observer in ("minmax", "frames") and not result.wider
        if rival and _worst(table[best]) > CLIPPING_PAYS * _worst(table[name]):
            return name
    return best


def float_costs_pct(checkpoint: Checkpoint) -> dict[str, float]:
    """What each block adds to the instructions of static INT8 when it is left in float, in percent; computed."""
    macs = multiply_accumulates(ACT(checkpoint.config, checkpoint.weights))
    whole = sum(macs.values())
    return {block: 100 * (FLOAT_PER_INT8 - 1) * macs[block] / whole for block in blocks(checkpoint.config)}


def _worst(errors: Mapping[str, Any]) -> float:
    """The larger error of the judged actions."""
    return worst(e for name, e in errors.items() if name.endswith("_mae_pct")) or 0.0
