"""Notebook 09: does a car drive better once it was corrected? Compare takeovers and learning with demonstrations.

    content = run_experiment("runs/demo", "runs/demo-learn")

In each round the policy drives with late plans and is pushed. An expert takes over where a human would, and drives on
to the end. Then the first checkpoint is trained further on everything recorded so far. The other arm learns from as
many seconds of whole drives by the same expert. Both are judged in worlds in which neither learned, as static INT8
artifacts, which are what would drive the car.
"""

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from balloon_world.drives import SEED, car_in_key, count_hits, drive_in, drive_missing, judge
from balloon_world.level import EASY, level_named
from balloon_world.record import BETWEEN_DRIVES, WorldEpisode, episode_name
from balloon_world.world import RATE_HZ, World, expert
from rover_learn.finetune import FinetuneRecipe, finetune
from rover_learn.training import Machine
from rover_lib.onboard.artifact.manifest import content_hash
from rover_lib.onboard.drive.pilot import Order
from rover_lib.onboard.drive.plan import Settings
from rover_lib.onboard.durable import build_folder
from rover_lib.onboard.errors import TrainingError
from rover_lib.onboard.params import params
from rover_lib.onboard.policy.load import Policy
from rover_lib.onboard.recording.episode import HUMAN, POLICY
from rover_lib.onboard.stage import plain, sha256_of, write_stage
from rover_lib.workshop.cache import key_of
from rover_lib.workshop.judge.compare import gate
from rover_lib.workshop.judge.pairs import sign_test
from rover_lib.workshop.notebook_table import Table
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.run.pipeline import make_artifact
from rover_lib.workshop.run.session import load

CORRECTED, DEMONSTRATED = ARMS = ("corrected", "demonstrated")
BEFORE = "before"  # the policy that both arms begin with
PUSHED, ALONE, DECOY = "pushed", "alone", "decoy"
FIRST_LEARNED = 2_000_000  # seeds of the worlds to learn in, far from those of recordings and trials
FIRST_DEMONSTRATED = 3_000_000
FIRST_DRIVE = datetime(2025, 6, 1, 12, tzinfo=UTC)  # invented, so that a seed's recording always has the same bytes
GATED_WORLDS = 40
OFF = 0.25  # a share of full steering
REACTS_S = 0.4  # then the human takes over
CHANCE = 0.05  # a difference counts if its sign test's p is below this
HALF_A_TICK_S = 0.5 / RATE_HZ
JUDGED_FRAMES = 2  # held-out frames of old episodes; two are enough, as worlds judge here
CHECKPOINT, EPISODES, ARTIFACT = "best_model.pth", "episodes", "policy_static.pt"
JUDGING = ("worlds", "other_worlds")
HOW = {PUSHED: "pushed", ALONE: "left alone", DECOY: "beside a red decoy"}
DRIVES_FILE = "drives.jsonl"


def human_beside(world: World) -> Callable[[Order], bool]:
    """Return a function to call with each tick's order in that world, which returns true when the human takes over.

    That is once the car has steered by OFF differently from how they would for REACTS_S without a break.
    """
    ticks = 0

    def takes_over(order: Order) -> bool:
        nonlocal ticks
        ticks = ticks + 1 if abs(expert(world)[0] - order.steering) > OFF else 0
        return ticks >= REACTS_S * RATE_HZ

    return takes_over


def drive_corrected(policy: Policy, folder: Path, index: int, world: World, experiment: "Experiment") -> dict[str, Any]:
    """Record drive number `index`: the policy drives until the human would take over, then the expert, to the end.

    Returns {"outcome", "taken_over_s": None if nobody had to, "human_s": for how long they drove}.
    """
    takes_over = human_beside(world)
    with _anew(folder, index, world) as episode:

        def watch(order: Order) -> bool:
            episode.tick(order.steering, order.throttle, driver=POLICY)
            return takes_over(order)

        if (outcome := experiment.drive(policy, world, watch)) != "taken over":
            return {"outcome": outcome, "taken_over_s": None, "human_s": 0.0}
        taken_over_s = world.state.time_s
        while not world.done:
            world.step(*episode.tick(*expert(world), driver=HUMAN))
        human_s = world.state.time_s - taken_over_s
        return {"outcome": str(world.outcome), "taken_over_s": taken_over_s, "human_s": human_s}


def demonstrate(folder: Path, index: int, world: World, most_s: float) -> float:
    """Record a whole drive of the expert, or its first most_s seconds. Returns how many seconds were recorded."""
    with _anew(folder, index, world) as episode:
        while not world.done and world.state.time_s < most_s - HALF_A_TICK_S:
            world.step(*episode.tick(*expert(world), driver=HUMAN))
    return world.state.time_s


@dataclass(frozen=True)
class Experiment:
    """How much is driven, learned and judged.

    rounds, drives: the number of rounds, and of drives in each. worlds: how many judge a policy that is pushed;
    other_worlds: left alone, and with decoys. pushes, decoys: in a world; every second world to learn in has decoys.
    level: of all worlds.
    samples: frames of each round, and of the first recordings, at most. steps: of learning; the recipe's if None.
    """

    rounds: int = 3
    drives: int = 20
    worlds: int = 200
    other_worlds: int = 100
    latency_ms: float = 300.0
    pushes: int = 4
    decoys: int = 1
    samples: int = 700
    steps: int | None = None
    level: str = EASY.name

    def drive(self, policy: Policy, world: World, watch: Callable[[Order], bool] | None = None) -> str:
        return drive_in(policy, world, self.latency_ms / 1e3, Settings.of(params()["drive"]), watch).outcome

    def learned_in(self, number: int, seed: int) -> World:
        """Return the world of a round's drive by its number."""
        return self.world(seed, self.pushes, self.decoys if number % 2 else 0)

    def world(self, seed: int, pushes: int, decoys: int) -> World:
        return World(seed, pushes, decoys, level=level_named(self.level))

    def recipe(self) -> FinetuneRecipe:
        """Return the recipe for both arms. It learns from all recordings of the rounds, as worlds judge here."""
        alike: dict[str, Any] = {"correction_weight": 1.0, "held_out_share": 0.0, "judged_frames": JUDGED_FRAMES}
        return FinetuneRecipe.of(steps=self.steps, samples=self.samples, **alike)


def run_experiment(
    run_dir: Path | str, out_dir: Path | str, experiment: Experiment, progress: Progress = silent
) -> dict[str, Any]:
    """Run both arms, round by round; write and return learn.json in the run's folder, stage 'learn'.

    run_dir: as `make demo` leaves it. out_dir: keeps what is recorded, learned and driven on the way, by experiment;
    after an end at any moment, the same call goes on from there. Raises TrainingError if the run lacks a file.
    """
    run_dir = Path(run_dir).resolve()
    out_dir = Path(out_dir).resolve()
    for name in (CHECKPOINT, EPISODES, ARTIFACT):
        if not (run_dir / name).exists():
            raise TrainingError(f"{run_dir / name}: not there", remedy="rover run makes it")
    inputs = {CHECKPOINT: sha256_of(run_dir / CHECKPOINT), ARTIFACT: content_hash(run_dir / ARTIFACT)}
    constants = {"drive": params()["drive"], "recipe": asdict(experiment.recipe()), "seed": SEED, **car_in_key()}
    parameters = plain(asdict(experiment) | constants)
    # More worlds may judge later.
    key_parameters = {name: value for name, value in parameters.items() if name not in JUDGING}
    if experiment.level == EASY.name:
        del key_parameters["level"]  # what was learned before there were levels stays valid
    lab = _Lab(experiment, run_dir, out_dir / key_of({"params": key_parameters, "inputs": inputs}), progress)
    rounds = [lab.round(number) for number in range(1, experiment.rounds + 1)]
    rows = lab.judge(rounds)
    metrics = {"rounds": rounds, "policies": rows, "gates": gates(rows)}
    return write_stage(run_dir / "learn.json", "learn", params=parameters, metrics=metrics, inputs=inputs)


@dataclass(frozen=True)
class _Lab:
    """An experiment in its folder: <arm>-<round>/ has episodes and drives.jsonl, learned/<arm>-<round>/ a policy."""

    experiment: Experiment
    run_dir: Path
    folder: Path
    progress: Progress

    def _learned(self, arm: str, number: int) -> Path:
        return self.folder / "learned" / _name(arm, number) / ARTIFACT

    def round(self, number: int) -> dict[str, Any]:
        """Drive and correct, then record as many seconds of demonstrations, and train both arms further."""
        before = self.run_dir / ARTIFACT if number == 1 else self._learned(CORRECTED, number - 1)
        drives = self._drive(before, number)
        human_s = sum(d["human_s"] for d in drives)
        if not human_s and number == 1:
            raise TrainingError("nobody had to take over", found=f"{len(drives)} drives", remedy="drive more")
        self._demonstrate(number, human_s)
        for arm in ARMS:
            if not self._learned(arm, number).is_file():
                folders = [self.folder / _name(arm, n) for n in range(1, number + 1)]
                self._learn(arm, number, [folder for folder in folders if any(folder.glob("episode_*"))])
        counts = {"takeovers": sum(d["taken_over_s"] is not None for d in drives), "drives": len(drives)}
        counts["missed"] = sum(d["outcome"] != "hit" for d in drives)
        return {"round": number, "human_s": human_s, **counts}

    def _learn(self, arm: str, number: int, recordings: Sequence[Path]) -> None:
        """Train the first checkpoint further on these recordings too, and make the artifact."""
        target = self._learned(arm, number)
        runs_dir = self.folder / "learned"
        if not (target.parent / "finetune.json").is_file():
            episodes = [self.run_dir / EPISODES, *recordings]
            recipe = self.experiment.recipe()
            options: dict[str, Any] = {"runs_dir": runs_dir, "recipe": recipe, "progress": self.progress}
            finetune(self.run_dir / CHECKPOINT, episodes, _name(arm, number), machine=Machine.of("cpu"), **options)
        run = load(target.parent / CHECKPOINT, self.run_dir / EPISODES, self.progress)
        make_artifact(run, target, params(), progress=self.progress)

    def _drive(self, artifact: Path, number: int) -> list[dict[str, Any]]:
        """Record a round's missing drives with a human beside the track, and return the rows of all."""
        folder = self.folder / _name(CORRECTED, number)
        first = 1000 * number

        def one(policy: Policy, question: tuple[str, int]) -> dict[str, Any]:
            i = question[1] - FIRST_LEARNED - first
            return drive_corrected(
                policy, folder, first + i, self.experiment.learned_in(i, question[1]), self.experiment
            )

        questions = [(CORRECTED, FIRST_LEARNED + first + i) for i in range(self.experiment.drives)]
        desc = f"driving, round {number}"
        return list(drive_missing(artifact, questions, one, folder / DRIVES_FILE, self.progress, desc).values())

    def _demonstrate(self, number: int, left_s: float) -> None:
        """Record left_s seconds of whole drives by the expert, unless they are there; the last drive is cut."""
        folder = self.folder / _name(DEMONSTRATED, number)
        index = 1000 * number
        if folder.exists():
            return
        with build_folder(folder) as new:
            while left_s > HALF_A_TICK_S:
                world = self.experiment.learned_in(index, FIRST_DEMONSTRATED + index)
                left_s -= demonstrate(new, index, world, left_s)
                index += 1

    def judge(self, rounds: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
        """Drive every policy through the worlds that judge, as far as missing, and return the rows of learn.json."""
        experiment = self.experiment

        def one(policy: Policy, kind: str, seed: int) -> str:
            world = experiment.world(seed, experiment.pushes * (kind == PUSHED), experiment.decoys * (kind == DECOY))
            return experiment.drive(policy, world)

        counts = {kind: experiment.worlds if kind == PUSHED else experiment.other_worlds for kind in HOW}
        artifacts = [(BEFORE, 0, self.run_dir / ARTIFACT)]
        for arm in ARMS:
            artifacts += [(arm, number, self._learned(arm, number)) for number in range(1, len(rounds) + 1)]
        rows = []
        for arm, number, artifact in artifacts:
            name = _name(arm, number) if number else BEFORE
            outcomes_by_kind = judge(artifact, counts, one, self.folder / f"{name}.jsonl", self.progress, name)
            human_s = float(sum(r["human_s"] for r in rounds[:number]))
            row: dict[str, Any] = {"name": name, "arm": arm, "round": number, "human_s": human_s}
            for kind, outcomes in outcomes_by_kind.items():
                row[kind] = count_hits(outcomes, key="wilson")
            rows.append(row)
        return rows


def _name(arm: str, number: int) -> str:
    return f"{arm}-{number}"


def _anew(folder: Path, index: int, world: World) -> WorldEpisode:
    """Return the recording of a drive, and remove what a killed process left of it."""
    start = FIRST_DRIVE + index * BETWEEN_DRIVES
    for path in folder.glob(f"*{episode_name(start)}*"):
        shutil.rmtree(path)
    return WorldEpisode(folder, start, world)


def _hits_of_40(drives: Mapping[str, Any]) -> int | None:
    """Return how many of the first GATED_WORLDS worlds were hit; None if not all of them were driven."""
    missed = sum(seed < SEED + GATED_WORLDS for seed in drives["missed"])
    return GATED_WORLDS - missed if drives["trials"] >= GATED_WORLDS else None


def gates(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Judge the last round by hits in notebook 07's 40 worlds, if all were driven, and by a sign test in all worlds."""
    last, other = ([row for row in rows if row["arm"] == arm][-1] for arm in ARMS)
    pushed, alone, before = (_hits_of_40(drives) for drives in (last[PUSHED], last[ALONE], rows[0][ALONE]))
    lost = None if alone is None or before is None else before - alone
    misses, other_misses = ({*row[PUSHED]["missed"]} for row in (last, other))
    p = sign_test(len(other_misses - misses), len(misses - other_misses))
    by_chance = p if last[PUSHED]["hits"] > other[PUSHED]["hits"] else 1.0
    least_hits = params()["gates"]["corrected_hits"]
    return [
        gate(f"hits of {GATED_WORLDS} when pushed, corrected", pushed, ">=", least_hits),
        gate(f"hits of {GATED_WORLDS} lost when left alone", lost, "<=", 0),
        gate("chance that demonstrations do as well when pushed, by a sign test", by_chance, "<=", CHANCE),
    ]


def table(content: Mapping[str, Any]) -> Table:
    """Show the policies of learn.json as a table."""
    rows = []
    for row in content["metrics"]["policies"]:
        counts = [row[kind] for kind in HOW]
        hits = [f"{c['hits']} of {c['trials']} ({c['wilson_low']:.0%} to {c['wilson_high']:.0%})" for c in counts]
        name = row["name"] if row["arm"] == BEFORE else f"{row['arm']}, round {row['round']}"
        rows.append((name, f"{row['human_s']:.0f}", *hits))
    return Table(("", "human s", *HOW.values()), rows, notes=["hits, with Wilson's 95 % interval"])
