"""Long drives in blocks: what is held out, and how far apart the parts are."""

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from rover_lib.workshop.int8.familiar import Drives
from rover_lib.workshop.recordings.blocks import name_blocks, name_long_drives
from rover_lib.workshop.recordings.episodes import split
from rover_lib.workshop.recordings.samples import Episode, Recordings, Sample, block_of, round_rate_hz
from rover_lib.workshop.recordings.source import Source

RATE_HZ, CHUNK = 20, 32


def drive(count, name="tub from 0", begin_s=0.0, session="s"):
    """An episode of a session, `count` frames long, whose actions are its session's frame numbers."""
    first, samples = round(begin_s * RATE_HZ), []
    for k in range(count):
        following = np.minimum(k + np.arange(CHUNK), count - 1)
        chunk = np.stack([following + first] * 2, 1).astype(np.float32)
        samples.append(Sample(name, Path("p.jpg"), k / RATE_HZ, chunk[0], chunk, k + np.arange(CHUNK) >= count, k))
    counts = count / RATE_HZ, count, count
    return Episode(name, Path("tub"), "", *counts, tuple(samples), (), {}, False, session, begin_s)


def parted(episodes, share=0.25, seed=0):
    named, names = name_blocks(episodes)
    return split(Recordings(Path("tub"), named, (), Source(Path("tub")), blocks=(names,)), share, seed)


@pytest.mark.parametrize(("count", "seed"), [(398, 0), (614, 0), (1098, 0), (1098, 1), (2239, 0), (14135, 0)])
def test_a_tenth_to_a_quarter_is_held_out_a_plan_away(count, seed):
    pieces = [drive(count // 2), drive(count - count // 2, "tub from 1", count // 2 / RATE_HZ + 0.2)]
    parts = parted(pieces, seed=seed)
    learned, chosen, judged = parts.calibration, parts.choosing, parts.held_out
    assert 0.1 < len(judged) / count < 0.25 and (len(judged) + len(chosen)) / count < 0.26
    assert len(learned) > 0.4 * count and "the same track and hour" in parts.note
    assert not set(parts.episodes["held_out"]) & {*parts.episodes["calibration"], *parts.episodes["choosing"]}
    times = [np.array([s.state[0] for s in part]) for part in (learned, chosen, judged)]
    for a, b in ((0, 1), (0, 2), (1, 2)):
        for border in (times[b].min(), times[b].max(), *times[b][:-1][np.diff(times[b]) > 1]):
            assert np.abs(times[a] - border).min() >= CHUNK - 4  # 0.2 s of the session were not recorded
    acted = [{*np.concatenate([s.chunk[~s.is_pad, 0] for s in part])} for part in (learned, chosen, judged)]
    assert not any(a & b for a, b in product(acted, acted) if a is not b)


def test_each_tub_has_enough_stretches_for_a_limit():
    parts = parted([drive(1098)])
    unseen = Drives.of(parts)
    assert len(unseen.unseen) >= 19 and not unseen.warnings and "stretches" in unseen.each
    assert sum(len(of) for of in unseen.unseen.values()) >= 0.4 * (len(parts.choosing) + len(parts.held_out))


def test_drives_of_seconds_and_many_of_them_are_parted_whole():
    long = replace(drive(100, "e0"), duration_s=90.0)
    short = [drive(100, f"e{i}", session="") for i in range(5)]
    for episodes in (short, [replace(long, id=f"e{i}") for i in range(20)]):
        assert name_long_drives(episodes) == (tuple(episodes), ())
        assert block_of(episodes[0].samples[0]) == "e0"
    (few, *_), ((*names,),) = name_long_drives([drive(2400, session=""), drive(2400, "tub from 1", session="")])
    assert few.samples[0].block == names[0] and len(names) == 12
    assert not name_blocks([drive(87)])[1]


@pytest.mark.parametrize(("frames", "count"), [(255, 0), (256, 8), (767, 8), (768, 12), (14135, 32), (40000, 67)])
def test_how_many_blocks_by_hand(frames, count):
    """A plan takes 1.6 s, eight 12.8 s and two times twelve 38.4 s; 707 s are 32 times 22 s, 2,000 s 67 times 30."""
    assert len(name_blocks([drive(frames)])[1]) == count


@pytest.mark.parametrize(
    ("found_hz", "kept_hz"), [(19.97, 20), (24.5, 24.5), (4.348, 4.348), (15.4, 15.4), (0.99, 1), (0.3, 0.3)]
)
def test_a_rate_is_rounded_only_as_far_as_no_plan_notices(found_hz, kept_hz):
    assert round_rate_hz(found_hz) == kept_hz
