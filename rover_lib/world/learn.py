"""Does a car that was corrected drive better? Rounds of drives, takeovers and learning, beside demonstrations.

    content = measured("runs/demo", "runs/demo-learn")

In each round the policy drives, late and pushed, and an expert takes over where a human would and drives on to the end.
From all that was recorded so far the first checkpoint learns on. The other arm learns the same way from as many seconds
of the same expert, who drives whole drives in such worlds. Both are judged in worlds that taught nobody.

All that drives is the static INT8 artifact: what would drive the car.
"""

import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from rover_lib.onboard.artifact import content_hash
from rover_lib.onboard.errors import RoverError, WorldError
from rover_lib.onboard.params import params
from rover_lib.onboard.pilot import Order
from rover_lib.onboard.plan import Settings
from rover_lib.onboard.policy import Policy
from rover_lib.onboard.recording import HUMAN, POLICY
from rover_lib.onboard.stage import atomic_path, plain, read_stage, sha256_of, write_stage
from rover_lib.workshop import pipeline
from rover_lib.workshop.cache import car_in_key
from rover_lib.workshop.cells import Table
from rover_lib.workshop.compare import gate
from rover_lib.workshop.finetune import FinetuneRecipe, finetune
from rover_lib.workshop.pipeline import make_artifact
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.session import load
from rover_lib.world.frontier import sign_test
from rover_lib.world.latency import SEED, Condition, Plans, drive_in, drive_late
from rover_lib.world.record import WorldEpisode, episode_name
from rover_lib.world.students import everywhere
from rover_lib.world.trial import wilson_interval
from rover_lib.world.world import RATE_HZ, World, expert

K = TypeVar("K")
V = TypeVar("V")

CORRECTED, DEMONSTRATED = ARMS = ("corrected", "demonstrated")
BEFORE = "before"  # the policy that all began with
PUSHED, ALONE, DECOY = "pushed", "alone", "decoy"
ROUNDS, DRIVES, WORLDS, OTHER_WORLDS = 3, 20, 200, 100
FIRST_LEARNED = 2_000_000  # worlds to learn in: far from those of recordings and trials
FIRST_DEMONSTRATED = 3_000_000
FIRST_DRIVE = datetime(2025, 6, 1, 12, tzinfo=UTC)  # made up, so that a seed's recording has the same bytes every time
BETWEEN_DRIVES = timedelta(seconds=30)
GATED_WORLDS = 40
CHANCE = 0.05  # a sign test's p below which a difference is one
HALF_A_TICK_S = 0.5 / RATE_HZ
JUDGED_FRAMES = 2  # of an old episode that is held out: here worlds judge
CHECKPOINT, EPISODES, ARTIFACT = "best_model.pth", "episodes", "policy_static.pt"
JUDGING = ("worlds", "other_worlds")
BEGUN, DRIVES_FILE = "experiment.json", "drives.jsonl"


@dataclass(frozen=True)
class Human:
    """When somebody beside the track takes over: once the car has steered otherwise than they would for some time.

    off: by how much, of full steering. for_s: how long, with the time that they need to react; what ends sooner is no
    reason.
    """

    off: float = 0.25
    for_s: float = 0.4

    def watching(self, world: World) -> Callable[[Order], bool]:
        """Asked at every tick of a drive through that world; true when they take over."""
        ticks = 0

        def takes_over(order: Order) -> bool:
            nonlocal ticks
            ticks = ticks + 1 if abs(expert(world)[0] - order.steering) > self.off else 0
            return ticks >= self.for_s * RATE_HZ

        return takes_over


@dataclass(frozen=True)
class Corrected:
    """A drive with a human beside it. outcome: of the whole, as LateDrive's. taken_over_s: None where nobody had to."""

    seed: int
    outcome: str
    taken_over_s: float | None
    human_s: float


def drive_corrected(
    policy: Plans, folder: Path, index: int, seed: int, condition: Condition, human: Human
) -> Corrected:
    """Record a drive, number `index`, in which the expert takes over where that human would, and drives to the end."""
    world = World(seed, condition.pushes, condition.decoys)
    takes_over = human.watching(world)
    with WorldEpisode(folder, _start(index), world) as episode:

        def watch(order: Order) -> bool:
            episode.tick(order.steering, order.throttle, driver=POLICY)
            return takes_over(order)

        driven = drive_in(policy, world, condition, watch)
        taken_over_s = world.state.time_s if driven.outcome == "taken over" else None
        if taken_over_s is None:
            return Corrected(seed, driven.outcome, None, 0.0)
        while not world.done:
            world.step(*episode.tick(*expert(world), driver=HUMAN))
        return Corrected(seed, str(world.outcome), taken_over_s, world.state.time_s - taken_over_s)


def demonstrate(folder: Path, index: int, seed: int, condition: Condition, most_s: float) -> float:
    """Record a whole drive of the expert, or its first most_s seconds. Returns how many there are."""
    world = World(seed, condition.pushes, condition.decoys)
    with WorldEpisode(folder, _start(index), world) as episode:
        while not world.done and world.state.time_s < most_s - HALF_A_TICK_S:
            world.step(*episode.tick(*expert(world), driver=HUMAN))
    return world.state.time_s


@dataclass(frozen=True)
class Experiment:
    """What is tried: rounds of that many drives; worlds that judge when pushed, and other_worlds when left alone and
    with decoys, the first of them notebook 07's. pushes and decoys: of a world; every second one to learn in has both.
    samples: frames at most of each round, and of what the policy began with, steps: of learning, the recipe's if None.
    """

    rounds: int = ROUNDS
    drives: int = DRIVES
    worlds: int = WORLDS
    other_worlds: int = OTHER_WORLDS
    latency_ms: float = 300.0
    pushes: int = 4
    decoys: int = 1
    human: Human = Human()
    samples: int = 700
    steps: int | None = None

    def __post_init__(self):
        if min(self.rounds, self.drives, self.worlds, self.other_worlds) < 1:
            found = f"{self.rounds}, {self.drives}, {self.worlds} and {self.other_worlds}"
            raise WorldError("learning needs at least one round, drive and world", found=found)

    def settings(self) -> Settings:
        return Settings.of(params()["drive"])

    def learned_in(self, number: int) -> Condition:
        """Of a round's drive."""
        return Condition(self.latency_ms / 1e3, self.settings(), self.pushes, self.decoys if number % 2 else 0)

    def judged_in(self) -> dict[str, Condition]:
        alone = Condition(self.latency_ms / 1e3, self.settings())
        return {PUSHED: replace(alone, pushes=self.pushes), ALONE: alone, DECOY: replace(alone, decoys=self.decoys)}

    def recipe(self) -> FinetuneRecipe:
        """For both arms, and all recordings of the rounds are learned from: worlds judge here."""
        alike = {"correction_weight": 1.0, "held_out_share": 0.0, "judged_frames": JUDGED_FRAMES}
        recipe = FinetuneRecipe.of(params(), samples=self.samples, **alike)
        return recipe.of_steps(self.steps) if self.steps else recipe


def measured(
    run_dir: Path | str, out_dir: Path | str, experiment: Experiment | None = None, progress: Progress = silent
) -> dict[str, Any]:
    """Both arms, round by round: the content of learn.json in the run's folder, stage 'learn'.

    run_dir: with best_model.pth, episodes/ and policy_static.pt, as `make demo` leaves them. out_dir: what is
    recorded, learned and driven on the way; ended at any moment, the same call goes on there. A learn.json made of the
    same is read.
    Raises WorldError where the run lacks something or out_dir is of another experiment, and what reading, learning and
    driving raise.
    """
    experiment = experiment or Experiment()
    run_dir, out_dir = Path(run_dir).resolve(), Path(out_dir).resolve()
    path = run_dir / "learn.json"
    for name in (CHECKPOINT, EPISODES, ARTIFACT):
        if not (run_dir / name).exists():
            raise WorldError(f"{run_dir / name}: not there", remedy="`make demo` makes it")
    inputs = {CHECKPOINT: sha256_of(run_dir / CHECKPOINT), ARTIFACT: content_hash(run_dir / ARTIFACT)}
    how = {"drive": params()["drive"], "recipe": asdict(experiment.recipe()), "seed": SEED, **car_in_key()}
    given = plain(asdict(experiment) | how)
    with suppress(RoverError):
        there = read_stage(path, "learn")
        if (there["params"], there["inputs"]) == (given, inputs):
            return there
    learned = {name: value for name, value in given.items() if name not in JUDGING}  # more worlds may judge later
    _begin(out_dir, {"params": learned, "inputs": inputs})
    lab = _Lab(experiment, run_dir, out_dir, progress)
    rounds = [lab.round(number) for number in range(1, experiment.rounds + 1)]
    lab.judge()
    metrics = _metrics(lab, rounds)
    return write_stage(path, "learn", params=given, metrics=metrics, inputs=inputs)


def left(run_dir: Path | str) -> dict[str, Any] | None:
    """What `measured` left in a run's folder, None where there is nothing."""
    path = Path(run_dir) / "learn.json"
    return read_stage(path, "learn") if path.is_file() else None


def _begin(out_dir: Path, made_of: dict[str, Any]) -> None:
    """What is in out_dir belongs to one experiment."""
    path = out_dir / BEGUN
    if path.is_file() and json.loads(path.read_text()) != made_of:
        raise WorldError(
            f"{out_dir}: holds another experiment, of another checkpoint or other parameters",
            remedy="remove it, or name another folder with --out",
        )
    if not path.is_file() and out_dir.is_dir() and any(out_dir.iterdir()):
        raise WorldError(f"{out_dir}: exists and is not of this", remedy="name another folder with --out")
    out_dir.mkdir(parents=True, exist_ok=True)
    if not path.is_file():
        with atomic_path(path) as temporary:
            temporary.write_text(json.dumps(made_of, indent=2) + "\n")


class _Lab:
    """One experiment in its folder: <arm>-<round>/ has episodes and drives.jsonl, learned/<arm>-<round>/ a policy."""

    def __init__(self, experiment: Experiment, run_dir: Path, folder: Path, progress: Progress):
        self.experiment, self.run_dir = experiment, run_dir
        self.folder, self.progress = folder, progress

    def policies(self) -> dict[str, Path]:
        """All artifacts, by name."""
        learned = {_name(arm, n): self._learned(arm, n) for arm in ARMS for n in range(1, self.experiment.rounds + 1)}
        return {BEFORE: self.run_dir / ARTIFACT, **learned}

    def _learned(self, arm: str, number: int) -> Path:
        return self.folder / "learned" / _name(arm, number) / ARTIFACT

    def round(self, number: int) -> dict[str, Any]:
        """Drive, correct, learn on; then as many seconds of demonstrations, and learn on from those."""
        before = self.run_dir / ARTIFACT if number == 1 else self._learned(CORRECTED, number - 1)
        drives = self._drive(before, number)
        human_s = sum(d["human_s"] for d in drives)
        self._demonstrate(number, human_s)
        for arm in ARMS:
            if not self._learned(arm, number).is_file():
                recorded = [self.folder / _name(arm, n) for n in range(1, number + 1)]
                if not any(_drives_of(folder, "human_s") for folder in recorded):
                    raise WorldError(
                        f"nobody had to take over in {len(drives)} drives: there is nothing to learn from",
                        remedy="drive more, later, or with more pushes",
                    )
                self._learn(arm, number, [folder for folder in recorded if any(folder.glob("episode_*"))])
        taken_over = [d for d in drives if d["taken_over_s"] is not None]
        return {
            "round": number,
            "human_s": human_s,
            "takeovers": len(taken_over),
            "drives": len(drives),
            "missed": sum(d["outcome"] != "hit" for d in drives),
        }

    def _learn(self, arm: str, number: int, recorded: Sequence[Path]) -> None:
        """A policy that has learned on from these, and its artifact."""
        target = self._learned(arm, number)
        if not (target.parent / "finetune.json").is_file():
            finetune(
                self.run_dir / CHECKPOINT,
                [self.run_dir / EPISODES, *recorded],
                _name(arm, number),
                runs_dir=self.folder / "learned",
                recipe=self.experiment.recipe(),
                device="cpu",
                progress=self.progress,
            )
        learned = load(target.parent / CHECKPOINT, self.run_dir / EPISODES, self.progress)
        make_artifact(learned, target, pipeline.Recipe.of(params()), progress=self.progress)

    def _drive(self, artifact: Path, number: int) -> list[dict[str, Any]]:
        """A round's drives with a human beside them, those that are not recorded yet."""
        folder = self.folder / _name(CORRECTED, number)
        done = _swept(folder)
        missing = [i for i in range(self.experiment.drives) if i not in done]
        if missing:

            def one(driver: Policy, i: int) -> dict[str, Any]:
                at, seed = 1000 * number + i, FIRST_LEARNED + 1000 * number + i
                driven = drive_corrected(driver, folder, at, seed, self.experiment.learned_in(i), self.experiment.human)
                return {"drive": i} | asdict(driven)

            every = everywhere(artifact, missing, one)
            for _, row in self.progress(every, desc=f"driving, round {number}", total=len(missing)):
                _append(folder / DRIVES_FILE, row)
        rows = _drives_of(folder)
        return [rows[i] for i in range(self.experiment.drives)]

    def _demonstrate(self, number: int, most_s: float) -> None:
        """As many seconds of whole drives of the expert; the last one is cut."""
        folder = self.folder / _name(DEMONSTRATED, number)
        _swept(folder)
        i, left_s = 0, most_s
        while left_s > HALF_A_TICK_S:
            rows = _drives_of(folder)
            if i not in rows:
                seed = FIRST_DEMONSTRATED + 1000 * number + i
                driven_s = demonstrate(folder, 1000 * number + i, seed, self.experiment.learned_in(i), left_s)
                _append(folder / DRIVES_FILE, {"drive": i, "seed": seed, "human_s": driven_s})
                rows = _drives_of(folder)
            left_s -= rows[i]["human_s"]
            i += 1

    def judge(self) -> None:
        """Drive all policies through the worlds that judge, those that have not been."""
        conditions = self.experiment.judged_in()

        def outcome_of(driver: Policy, asked: tuple[str, int]) -> str:
            how, seed = asked
            return drive_late(driver, seed, conditions[how]).outcome

        for name, artifact in self.policies().items():
            done = self.outcomes(name)
            missing = [(how, seed) for how in conditions for seed in self.seeds(how) if seed not in done[how]]
            if not missing:
                continue
            every = everywhere(artifact, missing, outcome_of)
            for (how, seed), outcome in self.progress(every, desc=f"judging {name}", total=len(missing)):
                _append(self.folder / f"{name}.jsonl", {"how": how, "seed": seed, "outcome": outcome})

    def seeds(self, how: str) -> range:
        """Of the worlds that judge under a condition."""
        return range(SEED, SEED + (self.experiment.worlds if how == PUSHED else self.experiment.other_worlds))

    def outcomes(self, name: str) -> dict[str, dict[int, str]]:
        """Of a policy, by condition and seed, in the worlds that judge; more of them may have been driven before."""
        found: dict[str, dict[int, str]] = {how: {} for how in self.experiment.judged_in()}
        for row in _rows(self.folder / f"{name}.jsonl"):
            if row["seed"] in self.seeds(row["how"]):
                found[row["how"]][row["seed"]] = row["outcome"]
        return found


def _name(arm: str, number: int) -> str:
    return f"{arm}-{number}"


def _rows(path: Path) -> list[dict[str, Any]]:
    """Lines of a file; one that a kill tore is none."""
    rows = []
    for line in path.read_text().splitlines() if path.is_file() else ():
        with suppress(ValueError):
            rows.append(json.loads(line))
    return rows


def _append(path: Path, row: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        file.write("\n" + json.dumps(plain(row)) + "\n")  # begins with one, in case the last was torn


def _drives_of(folder: Path, wanted: str = "drive") -> dict[int, dict[str, Any]]:
    """A folder's drives by number, of which `wanted` is said and not 0 (or is their number)."""
    return {r["drive"]: r for r in _rows(folder / DRIVES_FILE) if wanted == "drive" or r[wanted]}


def _swept(folder: Path) -> dict[int, dict[str, Any]]:
    """The drives that are whole; what a killed process left of others is removed."""
    done = _drives_of(folder)
    number = int(folder.name.rpartition("-")[2])
    kept = {episode_name(_start(1000 * number + i)) for i in done}
    for path in folder.glob("*") if folder.is_dir() else ():
        if path.is_dir() and path.name not in kept:
            shutil.rmtree(path)
    return done


def _start(index: int) -> datetime:
    """When a drive began, in a made-up calendar."""
    return FIRST_DRIVE + index * BETWEEN_DRIVES


# --- what is said of it -----------------------------------------------------------------------------------------------


def _metrics(lab: _Lab, rounds: Sequence[dict[str, Any]]) -> dict[str, Any]:
    experiment = lab.experiment
    spent = np.cumsum([r["human_s"] for r in rounds]).tolist()
    rows = []
    for name in lab.policies():
        arm, _, number = name.partition("-")
        found = {how: [s for s, o in sorted(by.items()) if o != "hit"] for how, by in lab.outcomes(name).items()}
        row: dict[str, Any] = {"name": name, "arm": arm, "round": int(number or 0)}
        row["human_s"] = spent[int(number) - 1] if number else 0.0
        for how, missed in found.items():
            trials = len(lab.seeds(how))
            hits = trials - len(missed)
            low, high = wilson_interval(hits, trials)
            row[how] = {
                "hits": hits,
                "trials": trials,
                "wilson_low": low,
                "wilson_high": high,
                "hits_of_40": sum(s not in missed for s in range(SEED, SEED + GATED_WORLDS)),
                "missed": missed,
            }
        rows.append(row)
    pairs = []
    by_name = {row["name"]: row for row in rows}
    for row in rows[1:]:
        others = [BEFORE] if row["arm"] == DEMONSTRATED else [BEFORE, _name(DEMONSTRATED, row["round"])]
        pairs += [_pair(row, by_name[other], how) for other in others for how in experiment.judged_in()]
    content = {"rounds": list(rounds), "policies": rows, "pairs": pairs}
    return content | {"gates": gates(rows), "said": sentences(content)}


def _pair(row: Mapping[str, Any], other: Mapping[str, Any], how: str) -> dict[str, Any]:
    """The same worlds, driven by both: which only one of them hit."""
    own, others = set(row[how]["missed"]), set(other[how]["missed"])
    only, only_other = len(others - own), len(own - others)
    return {
        "name": row["name"],
        "other": other["name"],
        "how": how,
        "only_hits": only,
        "only_other_hits": only_other,
        "sign_test_p": sign_test(only, only_other),
    }


def gates(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """What was promised of the last round; of notebook 07's 40 worlds, if all were driven. rows: of learn.json."""
    last = [row for row in rows if row["arm"] == CORRECTED][-1]
    hits = {how: last[how]["hits_of_40"] if last[how]["trials"] >= GATED_WORLDS else None for how in (PUSHED, ALONE)}
    lost = None if hits[ALONE] is None else rows[0][ALONE]["hits_of_40"] - hits[ALONE]
    other = [row for row in rows if row["arm"] == DEMONSTRATED][-1]
    by_chance = _pair(last, other, PUSHED)["sign_test_p"] if last[PUSHED]["hits"] > other[PUSHED]["hits"] else 1.0
    return [
        gate(f"hits of {GATED_WORLDS} when pushed, corrected", hits[PUSHED], ">=", params()["gates"]["corrected_hits"]),
        gate(f"hits of {GATED_WORLDS} lost when left alone", lost, "<=", 0),
        gate("chance that demonstrations do as well when pushed, by a sign test", by_chance, "<=", CHANCE),
    ]


NOTHING = "Nothing is here yet: `rover world learn runs/demo` drives, corrects and learns."
HOW = {PUSHED: "pushed", ALONE: "left alone", DECOY: "beside a red thing that is no balloon"}


def sentences(metrics: Mapping[str, Any]) -> list[str]:
    """What came of it, in plain English, whichever way. metrics: of learn.json."""
    rows = metrics["policies"]
    last = max(row["round"] for row in rows)
    seconds = next(row["human_s"] for row in rows if row["round"] == last)
    lines = [f"{last} rounds cost {seconds:.0f} human seconds, as many for the other arm."]
    for how, words in HOW.items():
        for other, name in ((BEFORE, "before"), (_name(DEMONSTRATED, last), "after demonstrations")):
            pair = next(
                p for p in metrics["pairs"] if (p["name"], p["other"], p["how"]) == (_name(CORRECTED, last), other, how)
            )
            own, others = (next(r for r in rows if r["name"] == pair[k])[how] for k in ("name", "other"))
            told = "better" if own["hits"] > others["hits"] else "worse"
            if pair["sign_test_p"] >= CHANCE:
                told = "neither better nor worse, as far as these worlds tell,"
            lines.append(
                f"{words[:1].upper()}{words[1:]}, the corrected policy is {told} than {name}: {own['hits']} of "
                f"{own['trials']} worlds, not {others['hits']}; {pair['only_hits']} only it hit, "
                f"{pair['only_other_hits']} only the other (sign test, p = {pair['sign_test_p']:.2g})."
            )
    return lines


def table(content: Mapping[str, Any] | None) -> Table:
    """learn.json for a reader; a sentence where there is none."""
    rows = []
    for row in content["metrics"]["policies"] if content else ():
        hits = (
            f"{found['hits']} of {found['trials']} ({found['wilson_low']:.0%} to {found['wilson_high']:.0%})"
            for found in (row[how] for how in HOW)
        )
        name = row["name"] if row["arm"] == BEFORE else f"{row['arm']}, round {row['round']}"
        rows.append((name, f"{row['human_s']:.0f}", *hits))
    notes = ["hits, with Wilson's 95 % interval"] if content else [NOTHING]
    return Table(("", "human s", *HOW.values()), rows, notes=notes)


def rounds_table(content: Mapping[str, Any] | None) -> Table:
    """What each round cost; a sentence where there is none."""
    rows = [
        (str(r["round"]), f"{r['takeovers']} of {r['drives']}", f"{r['human_s']:.1f}", str(r["missed"]))
        for r in (content["metrics"]["rounds"] if content else ())
    ]
    notes = () if content else (NOTHING,)
    return Table(("round", "drives with a takeover", "human s", "missed all the same"), rows, notes=notes)
