"""Our recordings, exported as a LeRobotDataset, are read back equal by LeRobot and by us."""

import json
import os
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from rover_exchange.export_dataset import _parts, export_dataset, lerobot_video
from rover_lib.onboard.car.car import Car, read_car, yaml_of
from rover_lib.onboard.errors import EpisodeError
from rover_lib.onboard.policy.preprocess import prepare_frame
from rover_lib.workshop.recordings.samples import car_of
from tests.helpers.command import rover
from tests.helpers.episodes import burst, edit, load, record, redrawn
from tests.helpers.recorded import record_there_and_back

CRAWLER = read_car(Path(__file__).parents[2] / "lab/cars/crawler.yml")

# Importing LeRobot and encoding tiny pictures as AV1 takes seconds.
pytestmark = pytest.mark.slow


@pytest.fixture
def recorded(tmp_path):
    for second in range(3):
        record(tmp_path / "mine", f"episode_20260101_12000{second}", frames=20)
    return tmp_path / "mine"


def check_equal(found, expected):
    assert len(found) == len(expected) > 0
    for ours, theirs in zip(found, expected, strict=True):
        for name in ("state", "chunk", "is_pad"):
            assert np.array_equal(getattr(ours, name), getattr(theirs, name))
        assert np.array_equal(ours.frame_bgr(), theirs.frame_bgr())


def theirs_of(root):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    return LeRobotDataset(f"local/{root.name}", root, video_backend="pyav")


def test_lerobot_reads_it_back_edits_it_and_so_do_we(recorded, tmp_path):
    from lerobot.datasets.dataset_tools import delete_episodes

    report = export_dataset(recorded, tmp_path / "out")
    original = load(recorded)
    assert (report["episodes"], report["frames"], report["frames_a_second"]) == (3, 60, 30)
    theirs = theirs_of(tmp_path / "out")
    assert theirs.meta.robot_type == "rover" and theirs.num_episodes == 3
    assert "intervention" not in theirs.meta.features
    for sample, item in zip(original.samples, theirs, strict=True):
        assert np.array_equal(item["observation.state"].numpy(), sample.state)
        assert np.array_equal(item["action"].numpy(), sample.chunk[0])
        pixels = (item["observation.images.cam_front"] * 255).round().byte().permute(1, 2, 0).numpy()
        assert np.array_equal(pixels[..., ::-1], sample.frame_bgr()) and item["task"] == "hit red balloon"
    again = load(tmp_path / "out")
    check_equal(again.samples, original.samples)
    assert {s.driver for s in again.samples} == {"human"} and again.layout.rate_hz == 30
    delete_episodes(theirs, [1], tmp_path / "less", "local/less")
    check_equal(load(tmp_path / "less").samples, [s for s in original.samples if s.episode != original.episodes[1].id])


def test_the_command_for_videos_that_is_printed_makes_them(recorded, tmp_path):
    export_dataset(recorded, tmp_path / "out")
    program, *words = lerobot_video(tmp_path / "out").split()
    offline = {**os.environ, "HF_HUB_OFFLINE": "1", "HF_HOME": str(tmp_path / "hf")}
    subprocess.run([Path(sys.executable).with_name(program), *words], check=True, capture_output=True, env=offline)
    made = theirs_of(tmp_path / "out-video")
    assert made.num_frames == 60 and made.meta.video_keys == ["observation.images.cam_front"]


def test_repairs_and_omissions_are_reported(recorded, tmp_path):
    first = recorded / "episode_20260101_120000"

    def change(content):
        burst(content, 10)
        content["control_samples"][4].update(throttle_raw_us=0, throttle_period_us=0, throttle_normalized=0.0)

    edit(first, change)
    (first / "frames/frame_000008.jpg").unlink()
    whole = (first / "frames/frame_000015.jpg").read_bytes()
    (first / "frames/frame_000015.jpg").write_bytes(whole[:200] + bytes(60) + whole[260:])  # torn
    result = rover("export-dataset", recorded, tmp_path / "out", "--json")
    assert result.exit_code == 0, result.output
    report = json.loads((tmp_path / "out/rover_export.json").read_text())
    kinds = {f["kind"]: f["count"] for f in report["faults_while_reading"]}
    assert kinds == {"serial_burst": 10, "throttle_zero_period": 1, "frame_missing": 1, "broken_jpeg": 1}
    assert (report["episodes"], report["frames"]) == (5, 58)
    assert report["episodes_are"][:3] == [f"episode_20260101_120000 from frame {n}" for n in (0, 8, 15)]
    original = load(recorded).samples
    again = load(tmp_path / "out").samples
    for ours, theirs in zip(again, original, strict=True):
        assert np.array_equal(ours.state, theirs.state) and np.array_equal(ours.chunk[0], theirs.chunk[0])
    check_equal(again[18:], original[18:])  # the first episode is in parts now


def test_what_cannot_be_one_dataset_is_refused(recorded, tmp_path):
    def refused(word, out="out", **options):
        with pytest.raises(EpisodeError, match=word):
            export_dataset(tmp_path / "mixed", tmp_path / out, **options)
        assert not list(tmp_path.glob(f".{out}*")) and (out != "out" or not (tmp_path / "out").exists())

    (tmp_path / "there").mkdir()
    refused("already", "there")
    record(tmp_path / "mixed", "episode_20260101_120000", frames=20)
    slow = record(tmp_path / "mixed", "episode_20260101_120001", frames=20)
    other = record(tmp_path / "mixed", "episode_20260101_120002", frames=20)

    def slower(content):
        for frame in content["frame_samples"]:
            frame["timestamp"] = 1000.1 + 2 * (frame["timestamp"] - 1000.1)

    edit(slow, slower)
    refused("15.0 in episode_20260101_120001")
    shutil.rmtree(slow)
    redrawn(lambda picture: np.full((18, 64, 3), 99, np.uint8))(other)
    refused("64x18 among those of 32x18")
    refused("found 32x9", size=(9, 32))
    report = export_dataset(tmp_path / "mixed", tmp_path / "out", size=(36, 64))
    assert report["pictures"] == "64x36, recorded 32x18"
    expected = [prepare_frame(s.frame_bgr(), 36, 64)[..., ::-1] for s in load(tmp_path / "mixed").samples]
    assert np.array_equal([s.frame_bgr() for s in load(tmp_path / "out").samples], expected)


def driven(folder, *spans):
    """Write into a recording who drove. spans: (driver, its first frame), in order."""

    def change(content):
        first_s = content["frame_samples"][0]["timestamp"]
        for row in content["control_samples"]:
            frame = round((row["system_timestamp"] - first_s) * 30)
            row["driver"] = next(driver for driver, since in reversed(spans) if frame >= since or not since)

    return edit(folder, change)


@pytest.fixture
def mixed(tmp_path):
    """Record a demonstration, a policy's drive, and a policy's drive that a human took over."""
    root = tmp_path / "mixed"
    for second in range(3):
        record(root, f"episode_20260101_12000{second}", frames=40)
    driven(root / "episode_20260101_120001", ("policy", 0))
    driven(root / "episode_20260101_120002", ("policy", 0), ("human", 15), ("nobody", 25), ("human", 32))
    return root


def test_interventions_are_lerobots(mixed, tmp_path):
    import torch

    report = export_dataset(mixed, tmp_path / "out")
    theirs = theirs_of(tmp_path / "out")
    # as lerobot-rollout writes it, in rollout/context.py
    assert theirs.meta.features["intervention"] == {"dtype": "bool", "shape": (1,), "names": None}
    ours = [s for s in load(mixed).samples if s.driver != "nobody"]
    assert report["left_out_nobody_drove"] == 6 and len(theirs) == len(ours) == 40 + 40 + 25 + 7
    marked = [bool(item["intervention"]) for item in theirs]
    assert marked == [s.driver == "human" and s.episode.endswith("2") for s in ours] and sum(marked) == 17
    assert report["episodes_are"][2:] == [f"episode_20260101_120002 from frame {n}" for n in (0, 33)]
    batch = next(iter(torch.utils.data.DataLoader(theirs, batch_size=8)))  # as LeRobot's training loads it
    assert batch["intervention"].dtype == torch.bool and batch["intervention"].numel() == 8
    again = load(tmp_path / "out")
    assert [s.driver for s in again.samples] == [s.driver for s in ours] and again.faults == ()
    check_equal(again.samples, ours)
    path = tmp_path / "out" / "rover_export.json"
    whole = json.loads(path.read_text())
    for other in ({"car": {"name": "a cat"}}, {"driven_by": ["human"]}):  # a report of another dataset is not used
        path.write_text(json.dumps(whole | other))
        again = load(tmp_path / "out")
        assert [f.kind for f in again.faults] == ["another_export"]
        assert {s.driver for s in again.episodes[0].samples} == {"policy"}
    path.unlink()  # without our report, all else is a policy's
    again = load(tmp_path / "out")
    assert [s.driver for s in again.episodes[0].samples] == ["policy"] * 40
    assert [s.driver for s in again.episodes[2].samples] == ["policy"] * 15 + ["human"] * 10


def test_a_dataset_of_another_car_is_read_as_its_own(tmp_path, monkeypatch):
    """Our report says whose car it is. Without it, a dataset counts as this machine's car's."""
    record_there_and_back(tmp_path / "mine/episode_20260101_120000", CRAWLER)
    export_dataset(tmp_path / "mine", tmp_path / "out")
    again = load(tmp_path / "out")
    assert car_of(again.samples) == CRAWLER and again.action_range()["throttle"] == pytest.approx((-0.1, 0.1))
    (tmp_path / "out" / "rover_export.json").unlink()
    with pytest.raises(EpisodeError, match="from 0 to 1"):  # the usual car has no reverse
        load(tmp_path / "out")
    (tmp_path / "car.yml").write_text(yaml_of(CRAWLER))
    monkeypatch.setenv("ROVER_CAR", str(tmp_path / "car.yml"))
    assert car_of(load(tmp_path / "out").samples) == CRAWLER
    record_there_and_back(tmp_path / "mine/episode_20260101_120001", Car())
    driven(record(tmp_path / "held", frames=20), ("nobody", 0))
    driven(record(tmp_path / "single", frames=20), ("human", 0), ("nobody", 1))
    for folder, word in (("mine", "several cars"), ("held", "no two whole frames"), ("single", "no two whole frames")):
        with pytest.raises(EpisodeError, match=word):
            export_dataset(tmp_path / folder, tmp_path / "new")
        assert not (tmp_path / "new").exists()


def test_a_part_ends_at_a_gap_and_where_a_plan_does():
    def sample(row, ends=False, driver="human"):
        return SimpleNamespace(row=row, is_pad=[False, ends], driver=driver, frame_bgr=lambda: PICTURE)

    rows = [sample(0), sample(1), sample(2), sample(5), sample(6, ends=True), sample(7), sample(8, driver="nobody")]
    left_out = Counter()
    parts = _parts(SimpleNamespace(samples=[*rows, sample(9)]), None, PICTURE.shape, left_out)
    assert [[sample.row for sample, _ in part] for part in parts] == [[0, 1, 2], [5, 6], [7], [9]]
    assert left_out == {"nobody_drove": 1}


PICTURE = np.zeros((18, 32, 3), np.uint8)
