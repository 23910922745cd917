"""Does the verdict's "ready" foretell driving? Policies of every quality, judged on recordings, then driven.

    python -m research.readiness WORK balloon CHECKPOINT  # goes on after an interruption; also on the demo's ACT
    python -m research.readiness WORK racing              # needs: pip install gymnasium box2d pygame
    python -m research.readiness WORK results/lab/readiness.json

Small networks are trained on 3 to 80 recorded drives, for 10 to 400 steps, with and without the state. Others come
from these, and from a checkpoint: noise on their weights, blends with untrained ones, plans that are blind in an
action, copy the state, turn too little, aside, or the wrong way. Each drives in WORLDS worlds; WORK/<world>/policies
keeps it.
"""

import copy
import json
import os
import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from balloon_world.record import FIRST_DRIVE, episode_name, record_drive
from balloon_world.world import World, expert
from rover_lib.onboard.policy.preprocess import prepare_frame
from rover_lib.onboard.stage import atomic_path, plain, write_stage
from rover_lib.workshop.act_config import lerobot_act
from rover_lib.workshop.checkpoint.checkpoint import load_checkpoint
from rover_lib.workshop.judge.compare import Fidelity
from rover_lib.workshop.judge.guesses import DRAWS, LAST, Judged, against_guesses, blind_plans, frame_errors
from rover_lib.workshop.judge.recorded_range import follows
from rover_lib.workshop.recordings.episodes import load_recordings

WORLDS, SEED, JUDGE_SEED, REPLAN = 40, 10_000, 1, 12
HEIGHT, WIDTH, CHUNK = 72, 128, 32
SHORT_S = 5.0  # of a judged drive in CarRacing: by then who does not see has left the road


# --- two worlds -------------------------------------------------------------------------------------------------------


class Balloon:
    """The balloon world: a drive's score is 1 if it hits."""

    name, drives, judged = "balloon", 80, 40

    def record(self, folder: Path, index: int, seed: int) -> None:
        record_drive(folder, index, seed)

    def worlds(self) -> list[Any]:
        return [World(SEED + i) for i in range(WORLDS)]

    def fresh(self, world: Any) -> Any:
        again = copy.copy(world)
        again.trajectory = [again.state]
        return again

    def expert(self, world: Any) -> tuple[float, float]:
        return expert(world)

    def score(self, world: Any) -> float:
        return float(world.hit)


class Racing:
    """CarRacing: a drive's score is how far it gets along the road, as a share of the driver's."""

    name, drives, judged = "racing", 100, 24

    def record(self, folder: Path, index: int, seed: int) -> None:
        from research.car_racing import record_drive

        record_drive(folder, index, seed)

    def worlds(self) -> list[Any]:
        from research.car_racing import Track

        return [Track(SEED + i, timeout_s=SHORT_S) for i in range(WORLDS)]

    def fresh(self, world: Any) -> Any:
        return world.restart()

    def expert(self, world: Any) -> tuple[float, float]:
        return world.expert()

    def score(self, world: Any) -> float:
        return world.score


WORLDS_BY_NAME: dict[str, Any] = {"balloon": Balloon, "racing": Racing}


# --- recordings -------------------------------------------------------------------------------------------------------


def recorded(kind: Any, folder: Path, part: str, count: int, seed: int, every: int) -> dict[str, np.ndarray]:
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

    drives, steps, state: what a network is trained on, for how long, and whether it is given the state; drives 0: the
    checkpoint's ACT. noise: of weights, in each tensor's spread, by seed. untrained: share of random weights. blind:
    actions whose plan is the recorded mean. copies: share of the state in a plan. turn: factor of what it steers.
    aside: of its steering.
    """

    drives: int = 80
    steps: int = 400
    state: bool = True
    noise: float = 0.0
    seed: int = 0
    untrained: float = 0.0
    blind: tuple[int, ...] = ()
    copies: float = 0.0
    turn: float = 1.0
    aside: float = 0.0

    @property
    def name(self) -> str:
        return json.dumps(vars(self)).translate(str.maketrans("", "", '"{} '))


def changes(act: bool) -> list[Change]:
    """Return every policy. act: whether there is a checkpoint of an ACT too."""
    bases = [Change(), Change(20), Change(steps=100, state=False), *([Change(0)] if act else [])]
    made = bases + [Change(drives, 400, state) for drives in (80, 20, 10, 5, 3) for state in (True, False)]
    made += [Change(80, steps, state) for steps in (10, 25, 50, 100, 200) for state in (True, False)]
    for base in bases:
        ways: list[dict[str, Any]] = [{"noise": 0.2}, {"copies": 0.5}, {"blind": (1,)}, {"turn": 0.5}]
        if base in (bases[0], Change(0)):
            ways += [
                {"noise": 0.1},
                {"noise": 0.3},
                {"noise": 0.5},
                {"untrained": 0.3},
                {"copies": 0.8},
                {"copies": 1.0},
            ]
            ways += [{"blind": (0,)}, {"turn": 0.2}, {"turn": -1.0}, {"aside": 0.15}]
        made += [Change(**{**vars(base), **way}) for way in ways]
    return list(dict.fromkeys(made))


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
        seen = self.see(frames.permute(0, 3, 1, 2).float() / 128 - 1)
        known = self.state * (state - self.mean) / self.spread
        return self.plan(torch.cat([seen, known], 1)).unflatten(1, (CHUNK, 2)) * self.spread + self.mean


def trained(base: Change, learned: dict[str, np.ndarray], folder: Path) -> Network:
    """Return the network of a base, trained unless it is kept."""
    known = ~learned["is_pad"]
    actions = learned["chunk"][known]
    torch.manual_seed(base.seed)
    network = Network(base.state, actions.mean(0), actions.std(0))
    path = folder / f"{base.name}.pth"
    if base.steps and not path.exists():
        rows = np.flatnonzero(learned["drive"] < base.drives)
        data = {k: torch.from_numpy(learned[k][rows]) for k in ("frames", "state", "chunk", "is_pad")}
        optimizer = torch.optim.AdamW(network.parameters(), 1e-3)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 2e-3, base.steps)
        for _ in range(base.steps):
            drawn = torch.randint(len(rows), (48,))
            batch = {k: v[drawn] for k, v in data.items()}
            off = (network(batch["frames"], batch["state"]) - batch["chunk"]).abs() / network.spread
            loss = (off.mean(2) * ~batch["is_pad"]).mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
        with atomic_path(path) as new:
            torch.save(network.state_dict(), new)
    if path.exists():
        network.load_state_dict(torch.load(path))
    return network.eval()


class Act(nn.Module):
    """A checkpoint's policy as a Network is called."""

    def __init__(self, checkpoint: Path | None):
        super().__init__()
        made = load_checkpoint(checkpoint)
        self._config = made.config
        self.policy = lerobot_act(made.config, made.weights)

    def forward(self, frames: Tensor, state: Tensor) -> Tensor:
        norm = self._config.image_norm[0]
        pixels = (frames / 255 * torch.tensor(norm.scale) + torch.tensor(norm.shift)).permute(0, 3, 1, 2)
        batch = {"observation.state": state, f"observation.images.{self._config.cameras[0]}": pixels.contiguous()}
        return torch.cat(
            [
                self.policy.predict_action_chunk({k: v[i : i + 25] for k, v in batch.items()})
                for i in range(0, len(frames), 25)
            ]
        )


class Changed:
    """A policy after its change. mean: (2,) recorded mean action."""

    def __init__(self, change: Change, network: nn.Module, mean: np.ndarray):
        self._change, self._network, self._mean = change, copy.deepcopy(network), mean
        rng = torch.Generator().manual_seed(change.seed)
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


def drive_all(kind: Any, worlds: Sequence[Any], act: Callable[[list[Any], np.ndarray], np.ndarray]) -> list[float]:
    """Drive through all worlds at once. act: worlds, and last actions (n, 2) -> plans (n, steps, 2) to drive by."""
    driven = [kind.fresh(world) for world in worlds]
    last = np.zeros((len(driven), 2))
    while left := [i for i, world in enumerate(driven) if not world.done]:
        for i, plan in zip(left, act([driven[i] for i in left], last[left]), strict=True):
            for action in plan:
                driven[i].step(*map(float, action))
                last[i] = action
                if driven[i].done:
                    break
    return [kind.score(world) for world in driven]


def judged_plans(policy: Changed, judge: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Plan on the held-out pictures: with the driver's last action as state, and with that of the own last plan."""
    frames, driver = judge["frames"], policy.plans(judge["frames"], judge["state"])
    own, first = driver.copy(), np.r_[True, np.diff(judge["drive"]) != 0]
    for step in range(1, int(judge["row"].max()) // REPLAN + 1):
        rows = np.flatnonzero((judge["row"] == step * REPLAN) & ~first)
        if len(rows):
            own[rows] = policy.plans(frames[rows], own[rows - 1][:, REPLAN - 1])
    some = np.linspace(0, len(frames) - 1, 48).round().astype(int)
    others = np.roll(some, 24)
    by_picture = np.abs(policy.plans(frames[others], judge["state"][some]) - driver[some]).mean((0, 1))
    return {
        "driver": driver,
        "own": own,
        "by_picture": by_picture,
        "apart": np.abs(driver[others] - driver[some]).mean((0, 1)),
    }


def judge_all(kind: Any, folder: Path, checkpoint: Path | None, processes: int) -> None:
    """Judge and drive every policy that has no file yet."""
    learned = recorded(kind, folder, "episodes", kind.drives, 0, 2)
    judge = recorded(kind, folder, "judge", kind.judged, JUDGE_SEED, REPLAN)
    kept, worlds = folder / "policies", kind.worlds()
    kept.mkdir(exist_ok=True)
    if not (folder / "driver.json").exists():
        drove = drive_all(kind, worlds, lambda left, _: np.array([[kind.expert(world)] for world in left]))
        (folder / "driver.json").write_text(json.dumps(drove))
    turn = next((i for i in range(1, processes) if os.fork() == 0), 0)  # each takes every processes-th policy
    queue = deque(changes(bool(checkpoint))[turn::processes])
    while queue:
        change = queue.popleft()
        path, base = kept / f"{change.name}.json", Change(change.drives, change.steps, change.state)
        if path.exists():
            continue
        if change not in (base, Change(0)) and base.drives and not (folder / f"{base.name}.pth").exists():
            queue.append(change)  # another process trains its base
            time.sleep(1)
            continue
        network = Act(checkpoint) if checkpoint and not change.drives else trained(base, learned, folder)
        policy = Changed(change, network, learned["chunk"][~learned["is_pad"]].mean(0))
        np.savez(path.with_suffix(".npz"), **judged_plans(policy, judge))

        def act(left: list[Any], last: np.ndarray, policy: Changed = policy) -> np.ndarray:
            frames = np.stack([prepare_frame(world.render(), HEIGHT, WIDTH) for world in left])
            return policy.plans(frames, last)[:, :REPLAN]

        scores = drive_all(kind, worlds, act)
        with atomic_path(path) as new:
            new.write_text(json.dumps(plain({"policy": vars(change), "scores": scores})))
        print(change.name, np.mean(scores), flush=True)


# --- rules ------------------------------------------------------------------------------------------------------------

SCORES = ("present", "whole plan", "later half", "own plans", "own plans, later half")
NONE, HALF, GOOD = "less than half", "in between", "good"  # how well it drives, beside the driver
GOOD_SHARE = 0.9


def fidelity_of(judge: dict[str, np.ndarray], plans: np.ndarray) -> Fidelity:
    """Return what the verdict judges, of plans (n, CHUNK, 2) on the held-out pictures."""
    names, known = ("steering", "throttle"), judge["chunk"][~judge["is_pad"]]
    ranges = {name: (float(known[:, i].min()), float(known[:, i].max())) for i, name in enumerate(names)}
    rows = zip(judge["drive"], judge["row"], judge["state"], strict=True)
    samples = tuple(SimpleNamespace(episode=str(d), block="", row=int(r), state=state) for d, r, state in rows)
    return Fidelity(names, ranges, samples, plans, {}, judge["chunk"], judge["is_pad"])


def lead_of(judged: Judged, but: Sequence[str] = ()) -> float:
    """The least lead that is sure, of all actions and guesses, as a share of the guess's error."""
    every = [(n, g) for found in judged.actions.values() if not found.held for n, g in found.guesses.items()]
    return min(g.low / g.error_pct for name, g in every if name not in but)


def present_rule(fidelity: Fidelity, learned: Sequence[Any], whole: Judged) -> tuple[float, bool]:
    """The rule before: nearer than each guess in every action, and surely so in their mean, over all steps."""
    states = np.stack([s.state for s in fidelity.samples])[:, None]
    units = np.array([fidelity.pct(name) for name in fidelity.action_names])
    own, copied = (units * frame_errors(p, fidelity.recorded, fidelity.is_pad) for p in (fidelity.reference, states))
    drives = np.array([s.episode for s in fidelity.samples])
    gains = {LAST: (copied - own).mean(1)}
    plans = blind_plans(np.stack([s.chunk for s in learned]), np.stack([s.is_pad for s in learned]))
    for name, plan in plans.items():
        gains[name] = (units * frame_errors(plan, fidelity.recorded, fidelity.is_pad) - own).mean(1)
    pieces = [np.flatnonzero(drives == drive) for drive in dict.fromkeys(drives.tolist())]
    draws = np.random.default_rng(0).integers(0, len(pieces), (DRAWS, len(pieces)))
    lows = []
    for gain in gains.values():
        sums, counts = (np.array([f(gain[p]) for p in pieces]) for f in (np.sum, len))
        lows.append(np.percentile(sums[draws].sum(1) / counts[draws].sum(1), 2.5) / (gain.mean() + own.mean()))
    nearer = all(f.error_pct < g.error_pct for f in whole.actions.values() for n, g in f.guesses.items() if n != LAST)
    nearer &= bool((own.mean(0) < copied.mean(0)).all())
    return min(lows), nearer and min(lows) > 0


def rows_of(folder: Path) -> list[dict[str, Any]]:
    """Return a row for each policy that was judged and driven: how it drove, and each score of SCORES."""
    judge, learned = (dict(np.load(folder / f"{part}.npz")) for part in ("judge", "episodes"))
    some = [SimpleNamespace(chunk=c, is_pad=p) for c, p in zip(learned["chunk"], learned["is_pad"], strict=True)]
    driver, rows = np.array(json.loads((folder / "driver.json").read_text())), []
    for path in sorted((folder / "policies").glob("*.json")):
        known, plans = json.loads(path.read_text()), dict(np.load(path.with_suffix(".npz")))
        fidelity, own = fidelity_of(judge, plans["driver"]), fidelity_of(judge, plans["own"])
        judged, by_own = against_guesses(fidelity, some), against_guesses(own, some)
        assert judged and by_own
        present, was_ready = present_rule(fidelity, some, judged)
        pct = np.array([fidelity.pct(name) for name in fidelity.action_names])
        moved = zip(pct * plans["by_picture"], pct * plans["apart"], strict=True)
        sees = [follows(float(by_picture), float(apart)) for by_picture, apart in moved]
        leads = (lead_of(judged, [LAST]), lead_of(judged), lead_of(by_own, [LAST]), lead_of(by_own))
        share = float(np.mean(known["scores"]) / driver.mean())
        row = {"policy": known["policy"], "share": share, "sees": sees, "was_ready": was_ready and any(sees)}
        row |= {"scores": dict(zip(SCORES, (present, *leads), strict=True))}
        rows.append(row | {"drives": NONE if share < 0.5 else GOOD if share >= GOOD_SHARE else HALF})
    return rows


def auc(rows: Sequence[dict[str, Any]], score: str) -> float:
    """Of two policies, one that drives at least half as well as the driver, how often that has the better score."""
    bad, others = (
        np.array([r["scores"][score] for r in rows if (r["drives"] == NONE) is kind]) for kind in (True, False)
    )
    return float((bad[:, None] < others).mean() + 0.5 * (bad[:, None] == others).mean())


def outcome(rows: Sequence[dict[str, Any]], ready: Sequence[bool]) -> dict[str, int]:
    """Count what a rule does: the bad ones that it lets drive, and the good ones that it refuses."""
    kinds = [row["drives"] for row in rows]
    found = {"bad": kinds.count(NONE), "good": kinds.count(GOOD)}
    found["bad_ready"] = sum(r and kind == NONE for r, kind in zip(ready, kinds, strict=True))
    return found | {"good_refused": sum(not r and kind == GOOD for r, kind in zip(ready, kinds, strict=True))}


def summarize(work: Path, output: Path) -> None:
    """Choose each score's margin in the first world, in steps of 0.05, try it in the other, and write the stage."""
    worlds = {name: rows_of(work / name) for name in WORLDS_BY_NAME}
    first, found = next(iter(worlds.values())), dict[str, Any]()
    for score in SCORES:
        bad = [row["scores"][score] for row in first if row["drives"] == NONE and all(row["sees"])]
        margin = max(0.0, np.ceil(20 * max(bad)) / 20)
        found[score] = {"margin": margin}
        for name, rows in worlds.items():
            ready = [all(row["sees"]) and row["scores"][score] > margin for row in rows]
            found[score][name] = {"auc": auc(rows, score)} | outcome(rows, ready)
    before = {name: outcome(rows, [row["was_ready"] for row in rows]) for name, rows in worlds.items()}
    given = {"worlds": WORLDS, "replan_every": REPLAN, "racing_s": SHORT_S, "good_share": GOOD_SHARE}
    metrics = {"before": before, "scores": found, "policies": worlds}
    write_stage(output, "readiness", params=given, metrics=metrics, inputs={})
    print(json.dumps(plain({"before": before, "scores": found}), indent=1))


def main(work: Path, what: str, checkpoint: str = "", processes: str = "2") -> None:
    torch.set_num_threads(1)
    if what.endswith(".json"):
        return summarize(work, Path(what))
    judge_all(WORLDS_BY_NAME[what](), work / what, Path(checkpoint) if checkpoint else None, int(processes))


if __name__ == "__main__":
    main(Path(sys.argv[1]), *sys.argv[2:])
