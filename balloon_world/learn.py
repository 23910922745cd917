"""Does a car drive better once it was corrected? Compare rounds of takeovers and learning with demonstrations.

    content = measured("runs/demo", "runs/demo-learn")

In each round the policy drives with late plans and is pushed. An expert takes over where a human would, and drives on
to the end. Then the first checkpoint is trained further on everything recorded so far. The other arm learns the same
way, but from as many seconds of whole drives by the same expert in such worlds. Both are judged in worlds in which
neither learned.

Every policy drives as its static INT8 artifact, which is what would drive the car.
"""

import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from balloon_world.frontier import sign_test
from balloon_world.latency import SEED, Condition, Plans, drive_in, drive_late
from balloon_world.record import WorldEpisode, episode_name
from balloon_world.side_by_side import append_row, everywhere, load_for_cores, read_rows
from balloon_world.trial import wilson_interval
from balloon_world.world import RATE_HZ, World, expert
from rover_learn.finetune import FinetuneRecipe, finetune
from rover_lib.onboard.artifact.manifest import content_hash
from rover_lib.onboard.drive.pilot import Order
from rover_lib.onboard.drive.plan import Settings
from rover_lib.onboard.errors import WorldError
from rover_lib.onboard.params import params
from rover_lib.onboard.policy.load import Policy
from rover_lib.onboard.recording.episode import HUMAN, POLICY
from rover_lib.onboard.stage import atomic_path, find_stage, plain, read_stage, sha256_of, write_stage
from rover_lib.workshop.cache import car_in_key
from rover_lib.workshop.judge.compare import gate
from rover_lib.workshop.notebook_table import Table
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.run import pipeline
from rover_lib.workshop.run.pipeline import make_artifact
from rover_lib.workshop.run.session import load

CORRECTED, DEMONSTRATED = ARMS = ("corrected", "demonstrated")
BEFORE = "before"  # the policy that both arms begin with
PUSHED, ALONE, DECOY = "pushed", "alone", "decoy"
ROUNDS, DRIVES, WORLDS, OTHER_WORLDS = 3, 20, 200, 100
FIRST_LEARNED = 2_000_000  # seeds of the worlds to learn in, far from those of recordings and trials
FIRST_DEMONSTRATED = 3_000_000
FIRST_DRIVE = datetime(2025, 6, 1, 12, tzinfo=UTC)  # invented, so that a seed's recording always has the same bytes
BETWEEN_DRIVES = timedelta(seconds=30)
GATED_WORLDS = 40
CHANCE = 0.05  # a difference counts if its sign test's p is below this
HALF_A_TICK_S = 0.5 / RATE_HZ
JUDGED_FRAMES = 2  # held-out frames of old episodes; two are enough, as worlds judge here
CHECKPOINT, EPISODES, ARTIFACT = "best_model.pth", "episodes", "policy_static.pt"
JUDGING = ("worlds", "other_worlds")
BEGUN, DRIVES_FILE = "experiment.json", "drives.jsonl"


@dataclass(frozen=True)
class Human:
    """Somebody beside the track, who takes over once the car has steered differently from how they would for some time.

    off: by how much it must differ, as a share of full steering. for_s: for how long without a break, which includes
    the time that they need to react.
    """

    off: float = 0.25
    for_s: float = 0.4

    def watching(self, world: World) -> Callable[[Order], bool]:
        """Return a function to call with each tick's order in that world; it returns true when the human takes over."""
        ticks = 0

        def takes_over(order: Order) -> bool:
            nonlocal ticks
            ticks = ticks + 1 if abs(expert(world)[0] - order.steering) > self.off else 0
            return ticks >= self.for_s * RATE_HZ

        return takes_over


@dataclass(frozen=True)
class Corrected:
    """A drive that a human watched.

    outcome: of the whole drive, as LateDrive's. taken_over_s: when the human took over, None if nobody had to.
    human_s: for how long the human drove.
    """

    seed: int
    outcome: str
    taken_over_s: float | None
    human_s: float


def drive_corrected(
    policy: Plans, folder: Path, index: int, seed: int, condition: Condition, human: Human
) -> Corrected:
    """Record drive number `index`: the policy drives until `human` would take over, then the expert, to the end."""
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
    """Record a whole drive of the expert, or its first most_s seconds. Returns how many seconds were recorded."""
    world = World(seed, condition.pushes, condition.decoys)
    with WorldEpisode(folder, _start(index), world) as episode:
        while not world.done and world.state.time_s < most_s - HALF_A_TICK_S:
            world.step(*episode.tick(*expert(world), driver=HUMAN))
    return world.state.time_s


@dataclass(frozen=True)
class Experiment:
    """How much is driven, learned and judged.

    rounds, drives: the number of rounds, and of drives in each. worlds: how many judge a policy that is pushed;
    other_worlds: how many judge it left alone, and how many with decoys. The first of all these are notebook 07's.
    pushes, decoys: in a world; of the worlds to learn in, all have the pushes and every second one the decoys too.
    samples: how many frames of each round, and of the first recordings, are learned from at most. steps: of learning;
    the recipe's if None.
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
        """Return the condition of a round's drive by its number."""
        return Condition(self.latency_ms / 1e3, self.settings(), self.pushes, self.decoys if number % 2 else 0)

    def judged_in(self) -> dict[str, Condition]:
        alone = Condition(self.latency_ms / 1e3, self.settings())
        return {PUSHED: replace(alone, pushes=self.pushes), ALONE: alone, DECOY: replace(alone, decoys=self.decoys)}

    def recipe(self) -> FinetuneRecipe:
        """Return the recipe for both arms. It learns from all recordings of the rounds, as worlds judge here."""
        alike: dict[str, Any] = {"correction_weight": 1.0, "held_out_share": 0.0, "judged_frames": JUDGED_FRAMES}
        return FinetuneRecipe.of(params(), steps=self.steps, samples=self.samples, **alike)


def run_experiment(
    run_dir: Path | str, out_dir: Path | str, experiment: Experiment | None = None, progress: Progress = silent
) -> dict[str, Any]:
    """Run both arms, round by round; write and return learn.json in the run's folder, stage 'learn'.

    run_dir: has best_model.pth, episodes/ and policy_static.pt, as `make demo` leaves them. out_dir: keeps what is
    recorded, learned and driven on the way; after an end at any moment, the same call goes on from there. A learn.json
    that was made from the same files and parameters is read, not made again.
    Raises WorldError if the run lacks a file or out_dir belongs to another experiment, and whatever reading, learning
    and driving raise.
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
    if there := find_stage(path, "learn", params=given, inputs=inputs):
        return there
    learned = {name: value for name, value in given.items() if name not in JUDGING}  # more worlds may judge later
    _begin(out_dir, {"params": learned, "inputs": inputs})
    lab = _Lab(experiment, run_dir, out_dir, progress)
    rounds = [lab.round(number) for number in range(1, experiment.rounds + 1)]
    lab.judge()
    metrics = _metrics(lab, rounds)
    return write_stage(path, "learn", params=given, metrics=metrics, inputs=inputs)


def read_experiment(run_dir: Path | str) -> dict[str, Any] | None:
    """Read what `measured` left in a run's folder; None if there is nothing."""
    path = Path(run_dir) / "learn.json"
    return read_stage(path, "learn") if path.is_file() else None


def _begin(out_dir: Path, made_of: dict[str, Any]) -> None:
    """Note in out_dir which experiment it belongs to. Raises WorldError if it holds another one or something else."""
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
    """An experiment in its folder: <arm>-<round>/ has episodes and drives.jsonl, learned/<arm>-<round>/ a policy."""

    def __init__(self, experiment: Experiment, run_dir: Path, folder: Path, progress: Progress):
        self.experiment, self.run_dir = experiment, run_dir
        self.folder, self.progress = folder, progress

    def policies(self) -> dict[str, Path]:
        """Return the paths of all artifacts by the policies' names."""
        learned = {_name(arm, n): self._learned(arm, n) for arm in ARMS for n in range(1, self.experiment.rounds + 1)}
        return {BEFORE: self.run_dir / ARTIFACT, **learned}

    def _learned(self, arm: str, number: int) -> Path:
        return self.folder / "learned" / _name(arm, number) / ARTIFACT

    def round(self, number: int) -> dict[str, Any]:
        """Drive and correct, then record as many seconds of demonstrations, and train both arms further."""
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
        """Train the first checkpoint further on these recordings too, and make the artifact."""
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
        """Return a round's drives with a human beside the track, and first record those that are missing."""
        folder = self.folder / _name(CORRECTED, number)
        done = _sweep_unfinished(folder)
        missing = [i for i in range(self.experiment.drives) if i not in done]
        if missing:

            def one(driver: Policy, i: int) -> dict[str, Any]:
                at, seed = 1000 * number + i, FIRST_LEARNED + 1000 * number + i
                driven = drive_corrected(driver, folder, at, seed, self.experiment.learned_in(i), self.experiment.human)
                return {"drive": i} | asdict(driven)

            every = everywhere(load_for_cores(artifact, len(missing)), missing, one)
            for _, row in self.progress(every, desc=f"driving, round {number}", total=len(missing)):
                append_row(folder / DRIVES_FILE, row)
        rows = _drives_of(folder)
        return [rows[i] for i in range(self.experiment.drives)]

    def _demonstrate(self, number: int, most_s: float) -> None:
        """Record most_s seconds of whole drives by the expert; the last drive is cut."""
        folder = self.folder / _name(DEMONSTRATED, number)
        _sweep_unfinished(folder)
        i, left_s = 0, most_s
        while left_s > HALF_A_TICK_S:
            rows = _drives_of(folder)
            if i not in rows:
                seed = FIRST_DEMONSTRATED + 1000 * number + i
                driven_s = demonstrate(folder, 1000 * number + i, seed, self.experiment.learned_in(i), left_s)
                append_row(folder / DRIVES_FILE, {"drive": i, "seed": seed, "human_s": driven_s})
                rows = _drives_of(folder)
            left_s -= rows[i]["human_s"]
            i += 1

    def judge(self) -> None:
        """Drive every policy through those of the judging worlds that it has not driven yet."""
        conditions = self.experiment.judged_in()

        for name, artifact in self.policies().items():
            done = self.outcomes(name)
            missing = [(how, seed) for how in conditions for seed in self.seeds(how) if seed not in done[how]]
            if not missing:
                continue
            every = everywhere(
                load_for_cores(artifact, len(missing)),
                missing,
                lambda driver, asked: drive_late(driver, asked[1], conditions[asked[0]]).outcome,
            )
            for (how, seed), outcome in self.progress(every, desc=f"judging {name}", total=len(missing)):
                append_row(self.folder / f"{name}.jsonl", {"how": how, "seed": seed, "outcome": outcome})

    def seeds(self, how: str) -> range:
        """Return the seeds of the worlds that judge under a condition."""
        return range(SEED, SEED + (self.experiment.worlds if how == PUSHED else self.experiment.other_worlds))

    def outcomes(self, name: str) -> dict[str, dict[int, str]]:
        """Return a policy's outcomes by condition and seed, only for the worlds that judge: its file may have more."""
        found: dict[str, dict[int, str]] = {how: {} for how in self.experiment.judged_in()}
        for row in read_rows(self.folder / f"{name}.jsonl"):
            if row["seed"] in self.seeds(row["how"]):
                found[row["how"]][row["seed"]] = row["outcome"]
        return found


def _name(arm: str, number: int) -> str:
    return f"{arm}-{number}"


def _drives_of(folder: Path, wanted: str = "drive") -> dict[int, dict[str, Any]]:
    """Return a folder's drives by number: all, or only those whose value of the key `wanted` is not 0."""
    return {r["drive"]: r for r in read_rows(folder / DRIVES_FILE) if wanted == "drive" or r[wanted]}


def _sweep_unfinished(folder: Path) -> dict[int, dict[str, Any]]:
    """Return the drives that are complete, and remove what a killed process left of others."""
    done = _drives_of(folder)
    number = int(folder.name.rpartition("-")[2])
    kept = {episode_name(_start(1000 * number + i)) for i in done}
    for path in folder.glob("*") if folder.is_dir() else ():
        if path.is_dir() and path.name not in kept:
            shutil.rmtree(path)
    return done


def _start(index: int) -> datetime:
    """Return when a drive began, by an invented calendar."""
    return FIRST_DRIVE + index * BETWEEN_DRIVES


# --- the results ------------------------------------------------------------------------------------------------------


def _metrics(lab: _Lab, rounds: Sequence[dict[str, Any]]) -> dict[str, Any]:
    experiment = lab.experiment
    spent = np.cumsum([r["human_s"] for r in rounds]).tolist()
    rows = []
    for name in lab.policies():
        arm, _, number = name.partition("-")
        row: dict[str, Any] = {"name": name, "arm": arm, "round": int(number or 0)}
        row["human_s"] = spent[int(number) - 1] if number else 0.0
        for how, outcomes in lab.outcomes(name).items():
            missed = [seed for seed, outcome in sorted(outcomes.items()) if outcome != "hit"]
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
    """Compare two policies in the same worlds: count the worlds that only one of them hit."""
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
    """Judge the last round by what was promised: hits in notebook 07's 40 worlds, and a sign test in all worlds.

    rows: of learn.json. Hits are judged only if all of those 40 worlds were driven.
    """
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
    """Say in plain English what the experiment showed, whatever it was. metrics: of learn.json."""
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
    """Show the content of learn.json as a table; None gives an empty one with a sentence that says what to do."""
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
    """Show what each round cost as a table; None gives an empty one with a sentence that says what to do."""
    rows = [
        (str(r["round"]), f"{r['takeovers']} of {r['drives']}", f"{r['human_s']:.1f}", str(r["missed"]))
        for r in (content["metrics"]["rounds"] if content else ())
    ]
    notes = () if content else (NOTHING,)
    return Table(("round", "drives with a takeover", "human s", "missed all the same"), rows, notes=notes)
