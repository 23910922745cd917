"""Drives with a human beside them, what is learned from that, and what is said of it."""

import shutil
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from balloon_world import drives, learn
from balloon_world.learn import Experiment, drive_corrected, gates, human_beside, run_experiment
from balloon_world.world import World, expert
from rover_learn.finetune import human_samples
from rover_lib.onboard.drive.pilot import Order
from rover_lib.onboard.errors import TrainingError
from rover_lib.onboard.params import params
from rover_lib.onboard.recording.episode import HUMAN, POLICY
from rover_lib.onboard.stage import read_stage
from rover_lib.workshop.recordings.episodes import load_recordings
from rover_lib.workshop.run.pipeline import make_artifact
from rover_lib.workshop.run.session import load
from tests.helpers.interrupted import interrupt
from tests.helpers.policies import of_a_cars_size

CURVE = 10_003  # the balloon is 23 degrees aside


class Straight:
    """Plans to drive on as it is, at the recordings' speed."""

    rate_hz = 30.0

    def predict_unclipped(self, frame_bgr, state):
        return np.tile(np.float32([0.0, 0.08]), (32, 1))


class NotDrawn(World):
    def render(self):
        return np.zeros((360, 640, 3), np.uint8)


def order(steering):
    return Order(steering, 0.05, 0, 0)


def test_a_human_takes_over_after_their_time_and_forgives_what_is_shorter():
    world = World(CURVE)
    takes_over, right, wrong = human_beside(world), order(expert(world)[0] - 0.2), order(expert(world)[0] - 0.3)
    assert [takes_over(wrong) for _ in range(11)] == [False] * 11
    assert not any(takes_over(right) for _ in range(60))
    assert [takes_over(wrong) for _ in range(12)] == [False] * 11 + [True]


def test_who_drove_is_in_the_recording_and_what_they_did_in_the_world(tmp_path):
    found = drive_corrected(Straight(), tmp_path, 7, NotDrawn(CURVE), Experiment())
    assert found["outcome"] == "hit" and found["taken_over_s"] is not None
    (episode,) = load_recordings(tmp_path, 32).episodes  # the policy's drive ended after the tick of the takeover
    drivers = [s.driver for s in episode.samples]
    first = drivers.index(HUMAN)
    assert drivers == [POLICY] * first + [HUMAN] * (len(drivers) - first)
    assert found["taken_over_s"] == pytest.approx(first / 30, abs=1e-6)
    assert found["human_s"] == pytest.approx((len(drivers) - first) / 30, abs=1e-6)
    corrections = human_samples(episode)
    assert corrections[0].row == first and not corrections[0].is_pad.all()
    # the expert's own drive from there: what is recorded is what was done, in an Arduino's steps
    world = NotDrawn(CURVE)
    for sample in episode.samples:
        if sample.driver == HUMAN:
            assert np.allclose(sample.chunk[0], expert(world), atol=0.01), sample.row
        world.step(*sample.chunk[0].astype(float))
    assert world.hit


def test_gates_are_of_the_last_round():
    """Of the stored results, and of the same with the arms exchanged: one of the two is sure to be no better."""
    metrics = read_stage(Path(__file__).parents[2] / "results" / "demo" / "learn.json", "learn")["metrics"]
    rows, arms = metrics["policies"], {"corrected": "demonstrated", "demonstrated": "corrected"}
    found = [row["found"] for row in gates(rows)]
    assert found == pytest.approx([row["found"] for row in metrics["gates"]], rel=1e-5)
    exchanged = gates([row | {"arm": arms.get(row["arm"], row["arm"])} for row in rows])
    assert max(found[2], exchanged[2]["found"]) == 1.0


@pytest.fixture(scope="module")
def run_dir(set_params, recorded, tmp_path_factory):
    """As `make demo` leaves one, of a policy that knows nothing."""
    set_params("calibration: {samples: 8}\nfinetune: {batch: 4}\n")
    folder = tmp_path_factory.mktemp("demo")
    (folder / "episodes").symlink_to(recorded)
    checkpoint = of_a_cars_size(folder / "best_model.pth")
    make_artifact(load(checkpoint, recorded), folder / "policy_static.pt", params())
    return folder


@pytest.fixture
def learned_once(monkeypatch):
    """Only the first training and export are real: the others get the same files. And what drives is a quick policy."""
    finetune, make, first = learn.finetune, learn.make_artifact, []

    def finetune_once(checkpoint, episodes, name, *, runs_dir, **how):
        if first:
            return shutil.copytree(first[0], runs_dir / name)
        finetune(checkpoint, episodes, name, runs_dir=runs_dir, **how)
        first.append(runs_dir / name)

    monkeypatch.setattr(drives, "load_policy", lambda artifact, threads: Straight())
    monkeypatch.setattr(learn, "finetune", finetune_once)
    monkeypatch.setattr(learn, "make_artifact", lambda it, to, *how, **more: to.exists() or make(it, to, *how, **more))


FEW = Experiment(rounds=2, drives=2, worlds=2, other_worlds=1, steps=2, samples=8)


@pytest.mark.slow
def test_both_arms_learn_from_as_many_seconds_and_a_kill_costs_nothing(run_dir, learned_once, tmp_path, monkeypatch):
    out = tmp_path / "learned"
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        interrupt(patch, learn, "drive_corrected", at=2)
        run_experiment(run_dir, out, FEW)
    assert not (run_dir / "learn.json").exists()
    (own,) = out.iterdir()  # this experiment's folder
    (half := own / "corrected-2" / "episode_20250602_044000").mkdir(parents=True)  # of a drive whose row is missing
    content = run_experiment(run_dir, out, FEW)
    assert content == read_stage(run_dir / "learn.json", "learn")
    assert (half / "episode_data.json").is_file()
    metrics = content["metrics"]
    names = ["before", "corrected-1", "corrected-2", "demonstrated-1", "demonstrated-2"]
    assert sorted(row["name"] for row in metrics["policies"]) == names
    assert metrics["policies"][-1]["human_s"] == pytest.approx(sum(r["human_s"] for r in metrics["rounds"]))
    for arm, row in product(learn.ARMS, metrics["rounds"]):
        episodes = load_recordings(own / f"{arm}-{row['round']}", 32).episodes
        seconds = sum(s.driver == HUMAN for e in episodes for s in e.samples) / 30
        assert seconds == pytest.approx(row["human_s"], abs=0.1)
    assert "corrected, round 2" in str(learn.table(content))
    more = run_experiment(run_dir, out, replace(FEW, worlds=3))  # only what is missing is driven
    assert [row["pushed"]["trials"] for row in more["metrics"]["policies"]] == [3] * 5 and [*out.iterdir()] == [own]


def test_what_is_missing_is_said(tmp_path):
    with pytest.raises(TrainingError, match="best_model"):
        run_experiment(tmp_path, tmp_path / "out", FEW)
    assert not list(tmp_path.iterdir())
