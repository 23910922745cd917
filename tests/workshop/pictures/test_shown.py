"""Pictures that are whole and show nothing, or something else than the other drives': each is named by its fault."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from balloon_world.world import World
from rover_lib.workshop.pictures.beside import find_swapped
from rover_lib.workshop.pictures.shown import with_faults
from rover_lib.workshop.recordings.episodes import load_recordings
from rover_lib.workshop.recordings.samples import Episode, Recordings
from rover_lib.workshop.recordings.source import Source
from tests.helpers.recorded import PictureSample, real_recordings

FRAMES, DRIVES = 60, 6


@cache
def drives():
    """Pictures and actions of drives through the balloon world, (FRAMES, h, w, 3) and (FRAMES, 2) each."""
    found = []
    for seed in range(DRIVES):
        world, pictures, actions = World(seed), [], []
        for k in range(FRAMES):
            actions.append((0.3 * np.sin(k / 9 + seed), 0.05))
            pictures.append(cv2.resize(world.render(), (96, 72), interpolation=cv2.INTER_AREA))
            world.step(*actions[-1])
        found.append((np.stack(pictures), np.float32(actions)))
    return found


def recordings(change, odd=(0, 1)):
    """The drives, of which the odd ones' pictures are changed."""
    episodes = []
    for d, (pictures, actions) in enumerate(drives()):
        seen = change(pictures) if d in odd else pictures
        samples = []
        for k in range(FRAMES):
            numbers = actions[max(k - 1, 0)], actions[k : k + 1], np.zeros(1, bool)
            samples.append(
                PictureSample(f"e{d}", Path("x.jpg"), k / 20, *numbers, k, picture=np.ascontiguousarray(seen[k]))
            )
        episodes.append(Episode(f"e{d}", Path("r"), "", FRAMES / 20, FRAMES, FRAMES, tuple(samples), ()))
    return with_faults(Recordings(Path("r"), tuple(episodes), (), Source(Path("r"))))


def frozen(pictures, first=20, count=25):
    still = np.repeat(pictures[first : first + 1], count, 0)
    return np.concatenate([pictures[:first], still, pictures[first + count :]])


def blank(value, share=2):
    def change(pictures):
        noise = np.random.default_rng(0).integers(0, 3, pictures.shape, np.uint8)
        return np.where(np.arange(FRAMES)[:, None, None, None] % share == 0, np.uint8(value) + noise, pictures)

    return change


def part(rows, value):
    def change(pictures):
        changed = pictures.copy()
        changed[:, rows] = value
        return changed

    return change


def grey(pictures):
    return np.repeat(pictures.mean(-1, keepdims=True), 3, -1).astype(np.uint8)


@pytest.mark.parametrize(
    ("change", "kind"),
    [
        (frozen, "frozen_camera"),
        (blank(0), "blank_pictures"),
        (blank(0, 1), "blank_pictures"),
        (blank(128), "blank_pictures"),
        (blank((0, 130, 0)), "blank_pictures"),
        (blank(250, 5), "blank_pictures"),
        (grey, "without_colours"),
        (lambda pictures: pictures * np.uint8((1, 1, 0)), "without_colours"),
        (lambda pictures: pictures * np.uint8((1, 0, 1)), "without_colours"),
        (lambda pictures: np.minimum(pictures * 5.0, 255).astype(np.uint8), "blank_pictures"),
        (part(slice(36), 4), "covered_lens"),
        (part(slice(36, 72), 4), "covered_lens"),
        (lambda pictures: pictures[np.arange(FRAMES) // 2 * 2], "repeated_pictures"),
        (lambda pictures: np.random.default_rng(0).permutation(pictures), "unordered_pictures"),
        (lambda pictures: np.random.default_rng(0).integers(0, 256, pictures.shape, np.uint8), "unordered_pictures"),
        (lambda pictures: pictures[..., ::-1], "swapped_colours"),
        (lambda pictures: pictures[:, ::-1, ::-1], "upside_down"),
        (lambda pictures: pictures[:, ::-1], "upside_down"),
        (lambda pictures: pictures, None),
    ],
)
@pytest.mark.parametrize("odd", [[1], [1, 4]])
def test_each_drive_that_shows_nothing_or_another_thing_is_named(change, kind, odd):
    found = recordings(change, odd)
    assert [(fault.file, fault.kind) for fault in found.faults] == [(f"e{d}", kind) for d in odd if kind]
    assert len(found.cautions()) == bool(kind) and found.faults_by_kind().keys() <= {"taken as recorded"}


def test_drives_through_rooms_of_other_colours_are_rarely_called_swapped():
    """In 10 of 60 draws of 3 to 8 worlds, which have floors and walls of their own; by likeness alone in 20."""
    seen = []
    for seed in range(30):
        world, pictures = World(seed), []
        for k in range(12):
            pictures.append(cv2.resize(world.render(), (96, 72), interpolation=cv2.INTER_AREA))
            for _ in range(5):
                world.step(0.3 * np.sin(k + seed), 0.05)
        seen.append(np.float32(pictures))
    rng = np.random.default_rng(0)
    draws = [rng.choice(len(seen), rng.integers(3, 9), replace=False) for _ in range(60)]
    assert sum(find_swapped([seen[i] for i in draw]).any() for draw in draws) <= 10


@pytest.mark.parametrize(("factors", "named"), [((0, 1), True), ((1, 0), False)])
def test_steering_that_never_changes_is_named_and_a_held_throttle_is_not(factors, named):
    found = recordings(lambda pictures: pictures)
    (first, *_) = found.episodes
    still = replace(first, samples=tuple(replace(sample, chunk=sample.chunk * factors) for sample in first.samples))
    cautions = replace(found, episodes=(still,)).cautions()
    assert any("steering is 0 throughout" in caution for caution in cautions) == named


@pytest.mark.parametrize("odd", [[2], range(DRIVES)])
def test_a_camera_that_stops_now_and_then_is_named(odd):
    """For 6 pictures of 20, in one drive or in all."""
    k = np.arange(FRAMES)
    (fault,) = recordings(lambda pictures: pictures[np.where(k % 20 < 6, k - k % 20, k)], odd).faults
    assert fault.kind == "repeated_pictures" and fault.file == ("e2" if odd == [2] else ".")


def test_a_dark_place_is_no_covered_lens():
    """But one that is dark in half of the drives alone is."""
    assert not recordings(part(slice(36), 4), range(DRIVES)).faults
    assert {fault.kind for fault in recordings(part(slice(36), 4), (0, 1, 2)).faults} == {"covered_lens"}


@pytest.mark.parametrize("times", [2, 3])
def test_pictures_that_stand_there_several_times_are_named_once(times):
    """As of a camera of 15 pictures a second in recordings of 30."""
    (fault,) = recordings(lambda pictures: pictures[np.arange(FRAMES) // times * times], range(DRIVES)).faults
    assert fault.kind == "repeated_pictures" and "is the camera slower" in fault.note


def test_a_car_that_stands_may_see_the_same():
    still = recordings(lambda pictures: pictures)
    episodes = []
    for episode in still.episodes:
        samples = []
        for s in episode.samples:
            picture = episode.samples[max(s.row, 30)].picture
            samples.append(replace(s, chunk=s.chunk * (1, s.row > 30), picture=picture))
        episodes.append(replace(episode, samples=tuple(samples)))
    assert with_faults(replace(still, episodes=tuple(episodes))).faults == ()


def test_real_recordings_have_no_such_fault():
    recordings = load_recordings(real_recordings(), 2)
    assert with_faults(recordings).faults == recordings.faults


def test_the_pieces_of_a_session_are_one_drive():
    """A camera stays as it is while a session lasts: a piece that looks turned over shows another place."""
    found = recordings(lambda pictures: pictures[:, ::-1], [1])
    joined = [replace(e, session="s" if e.id in ("e0", "e1", "e2") else e.id) for e in found.episodes]
    assert with_faults(replace(found, episodes=tuple(joined), faults=())).faults == ()
