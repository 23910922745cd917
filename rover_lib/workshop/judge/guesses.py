"""Hold a policy against its driver, beside guesses that need no eyes: a policy that is no better does not drive.

    judged = against_guesses(report, parts.calibration)
    for warning in judged.warnings(): ...

Each action is asked by itself. The guesses are a constant (the better of mean and median) and the mean plan, step by
step, of the recordings that the policy could learn from, and the last action again and again. That one is handed the
driver's own action at each picture, which no car has: it is asked for the later half of a plan only. A guess is beaten
if the policy is surely nearer to the driver: as few drives say little, that is asked of many draws of the held-out
drives, or of the blocks of long ones (a bootstrap). A throttle that hardly varies, there or in what the policy could
learn from, is held, and not judged.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import groupby
from typing import Any

import numpy as np

from rover_lib.workshop.judge.compare import Fidelity
from rover_lib.workshop.judge.recorded_range import HELD_OFF, hardly_varies, usual_size
from rover_lib.workshop.notebook_table import Table
from rover_lib.workshop.recordings.samples import Sample, block_of, stack_chunks

DRAWS = 2000
LEAST_EPISODES = 4  # of fewer, pieces are drawn instead, each as long as a plan
SURE_PCT = 95
MARGIN = 0.1  # a guess's error must surely be larger by this share of it: a policy of nearly the same is of no use
# Guesses that need no eyes.
MEAN = "the mean action"
MEDIAN = "the median action"
MEAN_PLAN = "the mean plan"
CONSTANT, LAST = "a constant", "the last action again"


@dataclass(frozen=True)
class Guess:
    """A guess of one action: its error, and by how much the policy is better: the mean, and the interval's ends.

    All in percent of the recorded range, of the plan's steps that it is asked for. The interval has SURE_PCT % of the
    draws.
    """

    error_pct: float
    better: float
    low: float
    high: float

    @property
    def beaten(self) -> bool:
        return self.low > MARGIN * self.error_pct

    def lead(self) -> str:
        return f"{self.better:.1f} points ({self.low:.1f} to {self.high:.1f})"


@dataclass(frozen=True)
class ActionJudged:
    """One action: the policy's error in percent of the recorded range, and the guesses by name.

    held: it hardly varies, so that it is not judged. off: the policy's error as a share of the action's usual size.
    """

    error_pct: float
    guesses: dict[str, Guess]
    held: bool
    off: float

    def lost(self) -> list[str]:
        """The guesses that are not beaten; none if the action is held."""
        return [] if self.held else [name for name, guess in self.guesses.items() if not guess.beaten]


@dataclass(frozen=True)
class Judged:
    """The result of `against_guesses`. drawn: how many drives, blocks or pieces were drawn from, in words."""

    actions: dict[str, ActionJudged]
    drawn: str

    def table(self) -> Table:
        """The policy and the guesses beside each other, for people."""
        rows = []
        for action, result in self.actions.items():
            rows.append((action, "the policy", f"{result.error_pct:.2f} %", "held, not judged" if result.held else ""))
            rows += [("", name, f"{g.error_pct:.2f} %", g.lead()) for name, g in result.guesses.items()]
        return Table(("", "", "off the driver", "the policy is better by"), rows)

    def warnings(self) -> list[str]:
        """A sentence for each action that is no better than a guess, or if none can be judged."""
        if all(result.held for result in self.actions.values()):
            return ["no action varies enough in these recordings to show whether the policy sees"]
        warnings = []
        for action, result in self.actions.items():
            if lost := result.lost():
                name = lost[0]
                when = " in the later half of a plan" if name == LAST else ""
                guess = result.guesses[name]
                errors = f"{guess.error_pct - guess.better:.2f} % off the driver{when}, {name} {guess.error_pct:.2f} %"
                lead = f"better by {guess.lead()} over {self.drawn}"
                warnings.append(f"{action} is not clearly better than a guess without eyes: {errors}; {lead}")
            if result.held and result.off > HELD_OFF:
                off = f"its plans are {100 * result.off:.0f} % off what is usual there"
                warnings.append(f"{action} hardly varies in these recordings, and {off}")
        return warnings

    def notes(self) -> list[str]:
        """A sentence for each action that is held."""
        notes = []
        for action, result in self.actions.items():
            if result.held:
                errors = f"{result.error_pct:.1f} % off, {CONSTANT} {result.guesses[CONSTANT].error_pct:.1f} %"
                notes.append(f"{action} hardly varies in these recordings: held, not judged ({errors})")
        return notes

    def summary(self) -> dict[str, Any]:
        """The same as plain JSON types, for compare.json."""
        lost = {action: result.lost() for action, result in self.actions.items()}
        return {**asdict(self), "lost": lost, "warnings": self.warnings(), "notes": self.notes()}


def blind_plans(chunks: np.ndarray, is_pad: np.ndarray) -> dict[str, np.ndarray]:
    """Return the plans, (C, A) each, that need no eyes, of what a policy could learn from.

    chunks: (n, C, A) recorded actions; is_pad: (n, C) bool, steps past the end of a recording.
    """
    actions = chunks[~is_pad].astype(np.float64)
    shape = chunks.shape[1:]
    # At a step that no plan reaches, the mean action stands.
    padded = np.broadcast_to(is_pad[..., None], chunks.shape)
    steps = np.ma.masked_array(chunks.astype(np.float64), padded).mean(0).filled(actions.mean(0))
    constants = {MEAN: actions.mean(0), MEDIAN: np.median(actions, 0)}
    return {name: np.broadcast_to(value, shape) for name, value in constants.items()} | {MEAN_PLAN: steps}


def frame_errors(plans: np.ndarray, recorded: np.ndarray, is_pad: np.ndarray) -> np.ndarray:
    """Return (n, A): each frame's mean absolute error over its recorded steps; NaN where none is.

    plans: (n, C, A), or one for all; recorded: (n, C, A); is_pad: (n, C).
    """
    errors = np.abs(plans.astype(np.float64) - recorded) * ~is_pad[..., None]
    count = (~is_pad).sum(1)[:, None]
    return np.divide(errors.sum(1), count, out=np.full_like(errors[:, 0], np.nan), where=count > 0)


def least_blind_errors(
    learned: np.ndarray, learned_pad: np.ndarray, recorded: np.ndarray, is_pad: np.ndarray
) -> np.ndarray:
    """Return (A,): by action, the mean error on recorded chunks of the best plan without eyes, in the action's unit.

    learned, learned_pad: what a policy could learn from; recorded, is_pad: what judges it: (n, C, A) and (n, C).
    """
    errors = [frame_errors(plan, recorded, is_pad).mean(0) for plan in blind_plans(learned, learned_pad).values()]
    return np.asarray(errors).min(0)


def against_guesses(report: Fidelity, learned: Sequence[Sample]) -> Judged | None:
    """Hold the FP32 plans of a comparison and the guesses against the driver, action by action.

    learned: samples of other drives, which the policy could learn from; the guesses know no others. None without any.
    An action that never changes is left out.
    """
    if not learned:
        return None
    recorded = report.recorded
    is_pad = report.is_pad
    half = recorded.shape[1] // 2
    chunks, padded = stack_chunks(learned)
    blind = blind_plans(chunks, padded)
    own = frame_errors(report.reference, recorded, is_pad)
    errors = {name: frame_errors(plan, recorded, is_pad) for name, plan in blind.items()}
    compared = {MEAN_PLAN: (errors[MEAN_PLAN], own)}
    states = np.stack([s.state for s in report.samples])
    if states.shape[1] == len(report.action_names):
        later = recorded[:, half:], is_pad[:, half:]
        compared[LAST] = frame_errors(states[:, None], *later), frame_errors(report.reference[:, half:], *later)
    drawn, pieces = _pieces(report)
    draws = np.random.default_rng(0).integers(0, len(pieces), (DRAWS, len(pieces)))
    acted = recorded[~is_pad]
    could_learn = chunks[~padded]
    actions = {}
    for i, action in enumerate(report.action_names):
        if (pct := report.pct(action)) is None:
            continue
        constant = min(errors[MEAN], errors[MEDIAN], key=lambda e: e[:, i].mean())
        guesses = {}
        for name, (of_guess, of_policy) in ({CONSTANT: (constant, own)} | compared).items():
            if not np.isnan(of_guess[:, i]).all():
                guesses[name] = _guess(pct * of_guess[:, i], pct * of_policy[:, i], pieces, draws)
        error = own[:, i].mean()
        is_constant = hardly_varies(action, acted[:, i]) or hardly_varies(action, could_learn[:, i])
        size = usual_size(acted[:, i])
        actions[action] = ActionJudged(float(pct * error), guesses, is_constant, float(error / size) if size else 0.0)
    return Judged(actions, drawn)


def _guess(of_guess: np.ndarray, of_policy: np.ndarray, pieces: Sequence[np.ndarray], draws: np.ndarray) -> Guess:
    """Compare errors (n,), NaN where a frame has none. draws: (DRAWS, pieces), numbers of pieces."""
    gain = of_guess - of_policy
    sums = np.array([np.nansum(gain[rows]) for rows in pieces])
    counts = np.array([np.count_nonzero(~np.isnan(gain[rows])) for rows in pieces])
    means = sums[draws].sum(1) / counts[draws].sum(1).clip(1)
    low, high = np.percentile(means, [(100 - SURE_PCT) / 2, (100 + SURE_PCT) / 2]).tolist()
    return Guess(float(np.nanmean(of_guess)), float(np.nanmean(gain)), low, high)


def _pieces(report: Fidelity) -> tuple[str, list[np.ndarray]]:
    """Return what is drawn from, in words, and for each piece the numbers of its frames."""
    samples = report.samples
    blocks = _runs([block_of(s) for s in samples])
    one_drive_each = all(len({samples[i].episode for i in rows}) == 1 for rows in blocks)
    unit = "episode" if one_drive_each and len({s.episode for s in samples}) == len(blocks) else "block"
    if len(blocks) >= LEAST_EPISODES:
        return f"{len(blocks)} {unit}s", blocks
    chunk = report.reference.shape[1]
    pieces = _runs([(block_of(s), s.episode, s.row // chunk) for s in samples])
    return f"{len(pieces)} pieces of {len(blocks)} {unit}{'s' if len(blocks) > 1 else ''}", pieces


def _runs(keys: Sequence[object]) -> list[np.ndarray]:
    """Return the numbers of the keys, for each run of equal ones."""
    return [np.array(list(numbers)) for _, numbers in groupby(range(len(keys)), key=keys.__getitem__)]
