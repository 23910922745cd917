"""Copies of drives, and mirrored ones, are left out; other drives are not."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rover_lib.workshop.recordings.faults import Faults
from rover_lib.workshop.recordings.samples import Episode
from rover_lib.workshop.recordings.twins import leave_out_copies
from tests.helpers.policies import smooth_frame
from tests.helpers.recorded import PictureSample

FRAMES = 30


def drive(seed):
    rng, samples = np.random.default_rng(seed), []
    for k in range(FRAMES):
        action = np.float32([[0.5 * np.sin(k / 5 + seed), 0.1 + 0.01 * seed]])
        picture = smooth_frame(rng, 36, 64)
        samples.append(
            PictureSample(f"e{seed}", Path("x"), k / 20, action[0], action, np.zeros(1, bool), k, picture=picture)
        )
    return Episode(f"a/e{seed}", Path("r"), "", 1.5, FRAMES, FRAMES, tuple(samples), ())


def mirrored(episode, name, noise=0):
    rng, samples = np.random.default_rng(1), []
    for s in episode.samples:
        noisy = s.picture[:, ::-1] + rng.integers(-noise, noise + 1, s.picture.shape)
        picture = noisy.clip(0, 255).astype(np.uint8)
        samples.append(replace(s, episode=name, chunk=s.chunk * np.float32([-1, 1]), picture=picture))
    return replace(episode, id=name, samples=tuple(samples))


@pytest.mark.parametrize("noise", [0, 4])
@pytest.mark.parametrize("frames", [FRAMES, 20])
def test_a_mirrored_copy_of_each_drive_is_left_out(noise, frames):
    drives, faults = [drive(seed) for seed in range(4)], Faults(Path("r"))
    twins = [mirrored(each, f"b/t{number}", noise) for number, each in enumerate(drives)]
    twins = [replace(each, samples=each.samples[:frames]) for each in twins]
    kept = leave_out_copies([*drives, *twins, replace(drives[0], id="again")], faults)
    assert [episode.id for episode in kept] == [f"a/e{seed}" for seed in range(4)]
    notes = {fault.file: fault.note for fault in faults.listed()}
    assert "mirrored" in notes["b/t2"] and "a/e2" in notes["b/t2"] and "a/e0" in notes["again"]


def test_a_drive_that_is_there_backwards_is_left_out():
    drives, faults = [drive(seed) for seed in range(3)], Faults(Path("r"))
    backwards = replace(drives[1], id="t", samples=drives[1].samples[25:3:-1])
    assert leave_out_copies([*drives, backwards], faults) == tuple(drives)
    assert "e1, backwards" in faults.listed()[0].note


@pytest.mark.parametrize(("same", "kept"), [(6, ["a/e0"]), (5, ["part", "a/e0"])])
def test_three_of_ten_runs_of_four_actions_make_a_copy(same, kept):
    whole = drive(0)
    part = replace(drive(7), id="part", samples=whole.samples[:same] + drive(7).samples[same:13])
    assert [episode.id for episode in leave_out_copies([part, whole], Faults(Path("r")))] == kept


def test_mirrored_steering_before_other_pictures_is_another_drive():
    drives, faults = [drive(seed) for seed in range(3)], Faults(Path("r"))
    pairs = zip(mirrored(drives[0], "t").samples, drives[1].samples, strict=True)
    other = [replace(s, picture=p.picture) for s, p in pairs]
    drives.append(replace(drives[0], id="t", samples=tuple(other)))
    assert leave_out_copies(drives, faults) == tuple(drives) and not faults.listed()
