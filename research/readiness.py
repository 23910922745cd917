"""Does the verdict's "ready" foretell driving? Policies of every quality, judged on recordings, then driven.

    python -m research.readiness WORK balloon             # goes on after an interruption
    python -m research.readiness WORK racing              # needs: pip install gymnasium box2d pygame
    python -m research.readiness WORK results/lab/readiness.json

Small networks are trained on 3 to 80 recorded drives, for 10 to 400 steps, with and without the state. Others come
from these: noise on their weights, blends with untrained ones, plans that are blind in an action, copy the state, turn
too little, aside, or the wrong way. Each drives in WORLDS worlds; WORK/<world>/rows.jsonl keeps its row.
"""

import copy
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from balloon_world.drives import append_row, read_rows
from balloon_world.record import FIRST_DRIVE, episode_name, record_drive
from balloon_world.world import World, expert
from rover_lib.onboard.policy.preprocess import prepare_frame
from rover_lib.onboard.stage import atomic_path, plain, write_stage
from rover_lib.workshop.judge.compare import Fidelity
from rover_lib.workshop.judge.guesses import MARGIN, against_guesses
from rover_lib.workshop.judge.recorded_range import follows
from rover_lib.workshop.recordings.episodes import load_recordings

WORLDS, SEED, JUDGE_SEED, REPLAN = 40, 10_000, 1, 12
HEIGHT, WIDTH, CHUNK = 72, 128, 32
ACTIONS = ("steering", "throttle")
SHORT_S = 5.0  # of a judged drive in CarRacing: by then who does not see has left the road
NONE, HALF, GOOD = "less than half", "in between", "good"  # how well it drives, beside the driver
GOOD_SHARE = 0.9


@dataclass(frozen=True)
class Kind:
    """A kind of world. make: by a seed. score: of a drive's end. drives, judged: recorded, to learn and to judge."""

    make: Callable[[int], Any]
    record: Callable[[Path, int, int], None]
    expert: Callable[[Any], tuple[float, float]]
    score: Callable[[Any], float]
    drives: int
    judged: int


def kind_of(name: str) -> Kind:
    """Return the balloon world, in which 1 is a hit, or CarRacing, where the metres along the road count."""
    if name == "balloon":
        return Kind(World, record_drive, expert, lambda world: float(world.hit), 80, 40)
    from research import car_racing

    def track(seed: int) -> car_racing.Track:
        return car_racing.Track(seed, timeout_s=SHORT_S)

    return Kind(track, car_racing.record_drive, car_racing.Track.expert, lambda world: world.score, 100, 24)


def recorded(kind: Kind, folder: Path, part: str, count: int, seed: int, every: int) -> dict[str, np.ndarray]:
    """Record what is missing, and return each `every`th sample as arrays, which are kept beside the recordings.

    frames (n, HEIGHT, WIDTH, 3) uint8 RGB, state (n, 2), chunk (n, CHUNK, 2), is_pad (n, CHUNK), drive and row (n,).
    """
    path = folder / f"{part}.npz"
    if not path.exists():
        (folder / part).mkdir(parents=True, exist_ok=True)
        for index in range(count):
            start = FIRST_DRIVE + timedelta(days=seed, seconds=30 * index)
            if not (folder / part / episode_name(start)).exists():
                kind.record(folder / part, index, seed)
        episodes = load_recordings(folder / part, CHUNK, 0.05).episodes
        some = [(i, s) for i, e in enumerate(episodes) for s in e.samples if s.row % every == 0]
        arrays = {name: np.stack([getattr(s, name) for _, s in some]) for name in ("state", "chunk", "is_pad", "row")}
        arrays["frames"] = np.stack([prepare_frame(s.frame_bgr(), HEIGHT, WIDTH) for _, s in some])
        arrays["drive"] = np.array([i for i, _ in some])
        np.savez(path, **arrays)
    return dict(np.load(path))


# --- policies ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Change:
    """How a policy is made.

    drives, steps, state: what a network is trained on, for how long, and whether it is given the state. noise: of
    weights, in each tensor's spread. untrained: share of random weights. blind: actions whose plan is the recorded
    mean. copies: share of the state in a plan. turn: factor of what it steers. aside: of its steering.
    """

    drives: int = 80
    steps: int = 400
    state: bool = True
    noise: float = 0.0
    untrained: float = 0.0
    blind: tuple[int, ...] = ()
    copies: float = 0.0
    turn: float = 1.0
    aside: float = 0.0


def changes() -> list[Change]:
    """Return every policy."""
    policies = [Change(drives, 400, state) for drives in (80, 20, 10, 5, 3) for state in (True, False)]
    policies += [Change(80, steps, state) for steps in (10, 25, 50, 100, 200) for state in (True, False)]
    few: list[dict[str, Any]] = [{"noise": 0.2}, {"copies": 0.5}, {"blind": (1,)}, {"turn": 0.5}]
    more: list[dict[str, Any]] = [{"noise": noise} for noise in (0.1, 0.3, 0.5)]
    more += [{"untrained": 0.3}, {"copies": 0.8}, {"copies": 1.0}, {"blind": (0,)}]
    more += [{"turn": 0.2}, {"turn": -1.0}, {"aside": 0.15}]
    policies += [Change(**way) for way in few + more]
    policies += [Change(20, **way) for way in few]
    return policies + [Change(steps=100, state=False, **way) for way in few]


class Network(nn.Module):
    """Five convolutions on half of the picture's sides, then the plan, in units of each action's spread."""

    def __init__(self, state: bool, mean: np.ndarray, spread: np.ndarray):
        super().__init__()
        sizes = [(3, 16), (16, 32), (32, 64), (64, 64)]
        layers = [m for i, o in sizes for m in (nn.Conv2d(i, o, 3, 2, 1), nn.BatchNorm2d(o), nn.ReLU())]
        self.see = nn.Sequential(nn.AvgPool2d(2), *layers, nn.Flatten())
        self.plan = nn.Sequential(nn.Linear(64 * 12 + 2, 128), nn.ReLU(), nn.Linear(128, 2 * CHUNK))
        self.state = state
        self.register_buffer("mean", torch.tensor(mean, dtype=torch.float32))
        self.register_buffer("spread", torch.tensor(spread, dtype=torch.float32))

    def forward(self, frames: Tensor, state: Tensor) -> Tensor:
        """(n, HEIGHT, WIDTH, 3) uint8 and (n, 2) -> plans (n, CHUNK, 2)."""
        features = self.see(frames.permute(0, 3, 1, 2).float() / 128 - 1)
        state = self.state * (state - self.mean) / self.spread
        return self.plan(torch.cat([features, state], 1)).unflatten(1, (CHUNK, 2)) * self.spread + self.mean


def train(change: Change, episodes: dict[str, np.ndarray], folder: Path) -> Network:
    """Return the network of a change, trained unless it is kept in the folder."""
    actions = episodes["chunk"][~episodes["is_pad"]]
    torch.manual_seed(0)
    network = Network(change.state, actions.mean(0), actions.std(0))
    path = folder / f"{change.drives}-drives-{change.steps}-steps{'-state' * change.state}.pth"
    if not path.exists():
        rows = np.flatnonzero(episodes["drive"] < change.drives)
        data = {k: torch.from_numpy(episodes[k][rows]) for k in ("frames", "state", "chunk", "is_pad")}
        optimizer = torch.optim.AdamW(network.parameters(), 1e-3)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 2e-3, change.steps)
        for _ in range(change.steps):
            chosen = torch.randint(len(rows), (48,))
            batch = {k: v[chosen] for k, v in data.items()}
            off = (network(batch["frames"], batch["state"]) - batch["chunk"]).abs() / network.spread
            loss = (off.mean(2) * ~batch["is_pad"]).mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
        with atomic_path(path) as new:
            torch.save(network.state_dict(), new)
    network.load_state_dict(torch.load(path))
    return network.eval()


class Changed:
    """A policy after its change. mean: (2,) recorded mean action."""

    def __init__(self, change: Change, network: nn.Module, mean: np.ndarray):
        self._change, self._network, self._mean = change, copy.deepcopy(network), mean
        rng = torch.Generator().manual_seed(0)
        for w in self._network.parameters():
            if w.ndim > 1:
                random = w.std() * torch.randn(w.shape, generator=rng)
                kept = (1 - change.untrained) * w + change.untrained * random
                w.data = kept + change.noise * random

    @torch.inference_mode()
    def plans(self, frames_rgb: np.ndarray, states: np.ndarray) -> np.ndarray:
        """(n, HEIGHT, WIDTH, 3) uint8 and (n, 2) -> (n, CHUNK, 2)."""
        plans = self._network(torch.from_numpy(frames_rgb), torch.from_numpy(states.astype(np.float32))).numpy().copy()
        change = self._change
        plans[..., 0] = self._mean[0] + change.turn * (plans[..., 0] - self._mean[0]) + change.aside
        plans[..., list(change.blind)] = self._mean[list(change.blind)]
        plans = (1 - change.copies) * plans + change.copies * states[:, None]
        return np.clip(plans, (-1, 0), 1).astype(np.float32)


# --- drives and judgements --------------------------------------------------------------------------------------------


def drive_all(kind: Kind, act: Callable[[list[Any], np.ndarray], np.ndarray]) -> float:
    """Drive through all worlds at once; return the mean score.

    act: worlds, and last actions (n, 2) -> plans (n, steps, 2) to drive by.
    """
    worlds = [kind.make(SEED + i) for i in range(WORLDS)]
    last = np.zeros((WORLDS, 2))
    while left := [i for i, world in enumerate(worlds) if not world.done]:
        for i, plan in zip(left, act([worlds[i] for i in left], last[left]), strict=True):
            for action in plan:
                worlds[i].step(*map(float, action))
                last[i] = action
                if worlds[i].done:
                    break
    return float(np.mean([kind.score(world) for world in worlds]))


def judge_one(policy: Changed, judge: dict[str, np.ndarray], episodes: dict[str, np.ndarray]) -> dict[str, Any]:
    """Judge a policy as the verdict does, on the held-out pictures.

    Returns whether its plans follow the picture, and its lead: the least that is sure, of all actions and guesses, as a
    share of the guess's error.
    """
    frames = judge["frames"]
    driven = judge["chunk"][~judge["is_pad"]]
    plans = policy.plans(frames, judge["state"])
    ranges = {name: (float(driven[:, i].min()), float(driven[:, i].max())) for i, name in enumerate(ACTIONS)}
    rows = zip(judge["drive"], judge["row"], judge["state"], strict=True)
    samples = tuple(SimpleNamespace(episode=str(d), block="", row=int(r), state=state) for d, r, state in rows)
    fidelity = Fidelity(ACTIONS, ranges, samples, plans, {}, judge["chunk"], judge["is_pad"])
    learned = zip(episodes["chunk"], episodes["is_pad"], strict=True)
    judged = against_guesses(fidelity, [SimpleNamespace(chunk=chunk, is_pad=is_pad) for chunk, is_pad in learned])
    guesses = [guess for each in judged.actions.values() if not each.held for guess in each.guesses.values()]
    some = np.linspace(0, len(frames) - 1, 48).round().astype(int)
    others = np.roll(some, 24)
    pct = np.array([fidelity.pct(name) for name in ACTIONS])
    moved = pct * np.abs(policy.plans(frames[others], judge["state"][some]) - plans[some]).mean((0, 1))
    apart = pct * np.abs(plans[others] - plans[some]).mean((0, 1))
    sees = all(follows(*each) for each in zip(moved.tolist(), apart.tolist(), strict=True))
    return {"sees": sees, "lead": min(guess.low / guess.error_pct for guess in guesses)}


def judge_all(kind: Kind, folder: Path) -> None:
    """Judge and drive every policy that has no row yet; the first row is the driver's own."""
    episodes = recorded(kind, folder, "episodes", kind.drives, 0, 2)
    judge = recorded(kind, folder, "judge", kind.judged, JUDGE_SEED, REPLAN)
    path = folder / "rows.jsonl"
    rows = read_rows(path)
    if not rows:
        score = drive_all(kind, lambda worlds, _: np.array([[kind.expert(world)] for world in worlds]))
        append_row(path, {"policy": None, "score": score})
    mean = episodes["chunk"][~episodes["is_pad"]].mean(0)
    for change in changes()[max(len(rows) - 1, 0) :]:
        policy = Changed(change, train(change, episodes, folder), mean)

        def act(worlds: list[Any], last: np.ndarray, policy: Changed = policy) -> np.ndarray:
            frames = np.stack([prepare_frame(world.render(), HEIGHT, WIDTH) for world in worlds])
            return policy.plans(frames, last)[:, :REPLAN]

        row = {"policy": vars(change), "score": drive_all(kind, act), **judge_one(policy, judge, episodes)}
        append_row(path, row)
        print(row, flush=True)


# --- the rule ---------------------------------------------------------------------------------------------------------


def rows_of(folder: Path) -> list[dict[str, Any]]:
    """Return the policies' rows, with their share of the driver's score, and that in words."""
    driver, *rows = read_rows(folder / "rows.jsonl")
    for row in rows:
        row["share"] = row.pop("score") / driver["score"]
        better = GOOD if row["share"] >= GOOD_SHARE else HALF
        row["drives"] = NONE if row["share"] < 0.5 else better
    return rows


def outcome(rows: Sequence[dict[str, Any]], margin: float) -> dict[str, Any]:
    """Count what a rule does: the bad ones that it lets drive, and the good ones that it refuses.

    auc: of two policies, one that drives at least half as well as the driver, how often that has the larger lead.
    """
    bad, others = (np.array([row["lead"] for row in rows if (row["drives"] == NONE) is kind]) for kind in (True, False))
    good = [row for row in rows if row["drives"] == GOOD]
    ready = [row["drives"] for row in rows if row["sees"] and row["lead"] > margin]
    auc = (bad[:, None] < others).mean() + 0.5 * (bad[:, None] == others).mean()
    counts = {"bad": len(bad), "good": len(good), "bad_ready": ready.count(NONE)}
    return counts | {"good_refused": len(good) - ready.count(GOOD), "auc": float(auc)}


def summarize(work: Path, output: Path) -> None:
    """Say what the verdict's margin does in each kind of world, and which suffices in the first; write the stage."""
    worlds = {name: rows_of(work / name) for name in ("balloon", "racing")}
    largest = max(row["lead"] for row in worlds["balloon"] if row["drives"] == NONE and row["sees"])
    rule = {"margin": MARGIN, "least_margin": max(0.0, largest)}
    outcomes = {name: outcome(rows, MARGIN) for name, rows in worlds.items()}
    given = {"worlds": WORLDS, "replan_every": REPLAN, "racing_s": SHORT_S, "good_share": GOOD_SHARE}
    metrics = rule | {"outcomes": outcomes, "policies": worlds}
    write_stage(output, "readiness", params=given, metrics=metrics, inputs={})
    print(json.dumps(plain(rule | outcomes), indent=1))


def main(work: Path, what: str) -> None:
    torch.set_num_threads(1)
    if what.endswith(".json"):
        return summarize(work, Path(what))
    judge_all(kind_of(what), work / what)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
