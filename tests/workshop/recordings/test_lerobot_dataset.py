"""LeRobotDatasets, made by LeRobot's own writer: every number and pixel as its own items have them, or one sentence."""

import functools
import json
import os
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow
import pytest
import torch
from click.testing import CliRunner
from pyarrow import parquet

from rover_lib.cli import main
from rover_lib.onboard.errors import CheckpointError, EpisodeError
from rover_lib.workshop.act import ACT, inputs_of, predictions
from rover_lib.workshop.checkpoint.checkpoint import load_checkpoint
from rover_lib.workshop.checkpoint.lerobot import write_lerobot
from rover_lib.workshop.recordings.episodes import load_recordings
from rover_lib.workshop.recordings.samples import Layout
from rover_lib.workshop.recordings.source import Source
from rover_lib.workshop.run.session import load
from tests.helpers.policies import TINY, lerobot_policy, memory_samples, saved_normalised
from tests.helpers.recorded import edit_json as edit
from tests.helpers.recorded import lerobot_dataset as make_dataset

CHUNK, FPS, SIZE = 8, 20, (72, 128)
CAR, SWAPPED = ("steering", "throttle"), ("throttle", "steering")
EPISODES, FRAMES = 3, 10
CAM = "observation.images.cam_front"

# ---- what is refused before LeRobot is asked: quick ---------------------------------------------------------------


def info(**changes):
    """meta/info.json of a dataset without data."""
    features = {
        "observation.images.front": {"dtype": "image", "shape": [*SIZE, 3], "names": ["height", "width", "channels"]},
        "observation.state": {"dtype": "float32", "shape": [2], "names": CAR},
        "action": {"dtype": "float32", "shape": [2], "names": CAR},
    }
    written = {"codebase_version": "v3.0", "fps": FPS, "features": features, "total_episodes": 1}
    written["data_path"] = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
    return written | changes


def written(root, content):
    (root / "meta").mkdir(parents=True, exist_ok=True)
    (root / "meta/info.json").write_text(content if isinstance(content, str) else json.dumps(content))
    return root


def refused(source, **options) -> str:
    with pytest.raises(EpisodeError) as e:
        load_recordings(source, CHUNK, **options)
    message = str(e.value)
    assert "\n" not in message and len(message) < 500
    return message


def features(**changes):
    """An edit of info()'s features: None removes one."""
    named = {"front": "observation.images.front", "state": "observation.state", "left": "observation.images.left"}
    content = info()
    for name, change in changes.items():
        content["features"][named.get(name, name)] = change
    content["features"] = {k: v for k, v in content["features"].items() if v is not None}
    return content


TWO = {"dtype": "float32", "shape": [2], "names": None}


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (info(codebase_version="v4.0"), "only v2 and v3"),
        (info(fps=0), "frames per second"),
        (info(codebase_version="v2.1", features={}), "features with dtype and shape, and meta/episodes_stats.jsonl is"),
        ("[" * 100_000, "JSON"),
        ("version https://git-lfs.github.com/spec/v1", "Git LFS"),
        (features(front=None), "has no camera"),
        (features(front={"dtype": "video", "shape": [*SIZE, 3], "info": {"is_depth_map": True}}), "colour camera"),
        (features(action=TWO | {"dtype": "bool"}), "not a row of numbers"),
        (features(action=TWO | {"names": {"steering": 1, "throttle": 1}}), "'action' does not name its 2 numbers"),
        (features(action=TWO | {"names": ["steering", "steering"]}), "correct its shape and names"),
        (features(), "has no meta/episodes"),
        (features(**{f"f{i}": TWO for i in range(40_000)}), "features with dtype"),
        (info(data_path=None), "lacks a data_path"),
    ],
)
def test_what_is_no_cars_dataset_is_refused(tmp_path, content, says):
    assert says in refused(written(tmp_path, content))


def test_a_camera_that_is_not_there_is_refused(tmp_path):
    assert "has no camera 'left', found front" in refused(Source.of(written(tmp_path, info()), camera="left"))
    assert "once each" in refused(Source.of(tmp_path, camera="front,front"))
    root = written(tmp_path, features(**{"observation.front": info()["features"]["observation.images.front"]}))
    assert "has 2 cameras" in refused(root), "none hides another"
    (own := tmp_path / "episode_20260101_120000").mkdir()
    assert "named actions" in refused(Source.of(own, "throttle,steering"))


# ---- what LeRobot's writer made ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def datasets(tmp_path_factory):
    """Makes each kind once."""

    def make(kind="image"):
        root = tmp_path_factory.mktemp("made") / kind
        return make_dataset(root, {"cam_front": SIZE}, CAR, FPS, range(FRAMES, FRAMES + EPISODES), kind, 0.5)

    return functools.cache(make)


@pytest.fixture
def copied(datasets, tmp_path):
    """A function that copies one of them, to be damaged."""
    return lambda kind="image": shutil.copytree(datasets(kind), tmp_path / kind)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["image", "video"])
def test_frames_states_and_chunks_are_lerobots_own_items(datasets, kind):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    root = datasets(kind)
    steps = {"action": [i / FPS for i in range(CHUNK)]}
    theirs = LeRobotDataset("local/made", root, delta_timestamps=steps, video_backend="pyav")
    recordings = load_recordings(root, CHUNK)
    assert len(recordings.samples) == len(theirs) == EPISODES * FRAMES + 3
    for sample, item in zip(recordings.samples, theirs, strict=True):
        assert np.array_equal(sample.state, item["observation.state"].numpy())
        assert np.array_equal(sample.chunk, item["action"].numpy())
        assert np.array_equal(sample.is_pad, item["action_is_pad"].numpy())
        assert sample.time_s == pytest.approx(item["timestamp"].item())
        rgb = torch.from_numpy(np.ascontiguousarray(sample.frame_bgr()[..., ::-1])).permute(2, 0, 1).float() / 255
        assert torch.equal(rgb, item[CAM])
    assert [e.label for e in recordings.episodes] == [f"hit the {i}. balloon" for i in range(EPISODES)]
    assert [e.frames for e in recordings.episodes] == [FRAMES, FRAMES + 1, FRAMES + 2]
    assert recordings.layout == Layout(("cam_front",), rate_hz=FPS) and json.dumps(recordings.summary())
    videos = {f"videos/{CAM}/chunk-000/file-000.mp4"} if kind == "video" else set()
    assert recordings.hashes().keys() == {"meta/info.json", DATA} | videos


DATA, EPISODES_AT = "data/chunk-000/file-000.parquet", "meta/episodes/chunk-000/file-000.parquet"
VIDEO_AT = f"videos/{CAM}/chunk-000/file-000.mp4"


def column(name, value=..., row=0):
    """Sets a row's value of a table's column, or changes all, or leaves the column out."""

    def change(path):
        read = parquet.read_table(path)
        at, values = read.column_names.index(name), read.column(name).to_pylist()
        if value is ...:
            return parquet.write_table(read.drop_columns([name]), path)
        values = [value(v) for v in values] if callable(value) else [*values[:row], value, *values[row + 1 :]]
        read = read.set_column(at, name, pyarrow.array(values, type=read.schema.field(name).type))
        parquet.write_table(read, path)

    return change


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "file", "damage", "says"),
    [
        ("video", VIDEO_AT, lambda p: os.truncate(p, p.stat().st_size // 2), "cannot be decoded"),
        # what LeRobot accepts without a word
        ("image", DATA, column("frame_index", 1), "belong together"),
        ("image", DATA, column("timestamp", 2.0, 3), "frames come at another rate"),
        ("image", "meta/info.json", lambda p: edit(p, lambda c: c.update(data_path="../x")), "leads out of the"),
        ("image", "data", lambda p: p.symlink_to(p.rename(p.parents[1] / "elsewhere")), "leads out of the dataset"),
        ("image", DATA, column("action"), "columns are not those of meta/info.json: a broken dataset, found action"),
        ("image", DATA, column("action", [30.0, 0.1]), "steering of 'action' is 30"),
        ("video", EPISODES_AT, column(f"videos/{CAM}/to_timestamp", 0.4), "episode 0, and 0 more, have another part"),
    ],
)  # fmt: skip
def test_damage_is_a_sentence(copied, kind, file, damage, says):
    root = copied(kind)
    damage(root / file)
    assert says in refused(root)


def table(path, change):
    parquet.write_table(change(parquet.read_table(path)), path)


def again(rows):
    """The first drive's actions and pictures in the second one, as in a dataset that was merged with itself."""
    for name in ("action", "observation.state", CAM):
        column = rows.column(name).take([*range(FRAMES), *range(FRAMES), *range(2 * FRAMES, rows.num_rows)])
        rows = rows.set_column(rows.column_names.index(name), name, column)
    return rows


@pytest.mark.slow
@pytest.mark.parametrize(
    ("file", "damage", "kind", "left"),
    [
        (DATA, column(CAM, None, 3), "broken_picture", 32),
        (DATA, column("observation.state", [0.1, np.nan]), "not_finite", 23),
        (DATA, lambda p: table(p, again), "copy", 23),
        ("meta/info.json", lambda p: edit(p, lambda c: c.update(total_frames=99)), "another_total", 33),
    ],
)
def test_what_is_damaged_is_left_out_and_what_is_denied_is_said(copied, file, damage, kind, left):
    root = copied()
    damage(root / file)
    recordings = load_recordings(root, CHUNK)
    assert [fault.kind for fault in recordings.faults] == [kind] and len(recordings.samples) == left


# ---- what others write in another way ------------------------------------------------------------------------------


def states_named(names):
    return lambda root: edit(root / "meta/info.json", lambda c: c["features"]["observation.state"].update(names=names))


def language(root):
    """A column of LeRobot 0.6, whose type 0.4 does not know."""
    said = [[{"role": "assistant", "content": "drive"}]] * 33
    table(root / DATA, lambda t: t.append_column("language_persistent", pyarrow.array(said)))
    more = {"language_persistent": {"dtype": "language", "shape": [1], "names": None}}
    edit(root / "meta/info.json", lambda c: c["features"].update(more))


def openpi(root):
    words = {"action": "actions", "observation.state": "state", CAM: "image"}
    table(root / DATA, lambda t: t.rename_columns([words.get(c, c) for c in t.column_names]))
    edit(root / "meta/info.json", lambda c: c.update(features={words.get(k, k): v for k, v in c["features"].items()}))


def leftovers(root):
    """A Mac's, Windows', notebooks', and a copy beside the file."""
    shutil.copytree(root / "meta/episodes/chunk-000", root / "meta/episodes/.ipynb_checkpoints")
    for name in ("._file-000.parquet", ".DS_Store", "Thumbs.db", "desktop.ini", "file-000 (1).parquet"):
        for folder in ("data/chunk-000", "meta/episodes/chunk-000", "meta"):
            (root / folder / name).write_bytes(b"\0\5\26\7" + bytes(60))


def version_2(root):
    """As LeRobot of early 2025 wrote it, and without the statistics that its converter needs."""
    rows, episodes = parquet.read_table(root / DATA), parquet.read_table(root / EPISODES_AT).to_pylist()
    for i, episode in enumerate(episodes):
        part = rows.slice(episode["dataset_from_index"], episode["length"])
        parquet.write_table(part, root / f"data/chunk-000/episode_{i:06d}.parquet")
    lines = [json.dumps({key: row[key] for key in ("episode_index", "length", "tasks")}) for row in episodes]
    (root / "meta/episodes.jsonl").write_text("\n".join(lines) + "\n")
    path = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
    edit(root / "meta/info.json", lambda c: c.update(codebase_version="v2.1", data_path=path))


def tasks_in_a_column(root):
    words = [f"hit the {i}. balloon" for i in range(EPISODES)]
    parquet.write_table(pyarrow.table({"task_index": range(EPISODES), "task": words}), root / "meta/tasks.parquet")


OTHERS_WAYS = [
    (language, set()),
    (lambda root: table(root / DATA, lambda t: t.append_column("__index_level_0__", pyarrow.array(range(33)))), set()),
    (tasks_in_a_column, set()),
    (leftovers, set()),
    (openpi, set()),
    (lambda root: column("dataset_to_index", 10, 2)(root / EPISODES_AT), {"scrambled_index"}),
    (version_2, set()),
    (lambda root: column("index", lambda i: i + 100)(root / DATA), set()),
    (lambda root: column("timestamp", lambda time_s: time_s + 256)(root / DATA), set()),
    (lambda root: edit(root / "meta/info.json", lambda c: c["features"]["action"].update(names=[[*CAR]])), set()),
    (states_named("steering, throttle"), set()),
    (states_named({"1": "throttle", "0": "steering"}), set()),
    (lambda root: column("timestamp", lambda time_s: 1000 * time_s)(root / DATA), {"other_units"}),
    (lambda root: edit(root / "meta/info.json", lambda c: c["features"][CAM].update(shape=[3, *SIZE])), set()),
]


@pytest.mark.slow
@pytest.mark.parametrize(("change", "faults"), OTHERS_WAYS)
def test_what_others_write_in_another_way_is_read_the_same(datasets, copied, change, faults):
    root, right = copied(), load_recordings(datasets(), CHUNK)
    change(root)
    found = load_recordings(root, CHUNK)
    assert {fault.kind for fault in found.faults} == faults
    assert [e.label for e in found.episodes] == [e.label for e in right.episodes]
    for ours, theirs in zip(found.samples, right.samples, strict=True):
        assert np.array_equal(ours.state, theirs.state) and np.array_equal(ours.chunk, theirs.chunk)
        assert np.array_equal(ours.frame_bgr(), theirs.frame_bgr())


def named(**names):
    def change(root):
        said = {"action": names["action"], "observation.state": names["state"]}
        edit(root / "meta/info.json", lambda c: [c["features"][key].update(names=said[key]) for key in said])

    return change


def second_camera(root):
    table(root / DATA, lambda t: t.append_column("observation.images.left", t.column(CAM)))
    edit(root / "meta/info.json", lambda c: c["features"].update({"observation.images.left": c["features"][CAM]}))


def renamed(old, new):
    """Rename a feature, in meta/info.json and in the table."""

    def change(root):
        table(root / DATA, lambda t: t.rename_columns([new if name == old else name for name in t.column_names]))
        edit(root / "meta/info.json", lambda c: c["features"].update({new: c["features"].pop(old)}))

    return change


def shaped(key, shape):
    return lambda root: edit(root / "meta/info.json", lambda c: c["features"][key].update(shape=shape))


def as_printed(message, root, whole):
    """Do what a refusal's remedy says, and return what is to be read then."""
    if given := re.search(r"--action-names ([a-z_0-9]+,[a-z_0-9]+)", message.partition(";")[2]):
        return Source.of(root, given[1])
    if "--camera NAME" in message:
        return Source.of(root, camera=re.search(r"found (\w+),", message)[1])
    if found := re.search(r"such as (.+)$", message):
        return Path(found[1])
    if found := re.search(r"call it '(.+?)' in meta/info.json and in the tables", message):
        renamed("act" if found[1] == "action" else "observation.joints", found[1])(root)
    elif "correct the rate" in message:
        edit(root / "meta/info.json", lambda c: c.update(fps=FPS))
    elif "correct its shape and names" in message:
        shaped("observation.state", [2])(root)
    elif "correct meta/info.json" in message or "scale them down" in message:
        shaped(CAM, [*SIZE, 3])(root)
    else:
        assert message.endswith(("let LeRobot write it anew", "git lfs pull"))
        shutil.rmtree(root)
        shutil.copytree(whole, root)
    return root


TRIGGERS = [
    (named(action=None, state=None), (0, 1)),
    (named(action={"motors": [*SWAPPED]}, state=None), (1, 0)),
    (named(action=None, state=[[*SWAPPED]]), (1, 0)),
    (named(action=["linear.vel", "angular.vel"], state=["linear.vel", "angular.vel"]), (1, 0)),
    (second_camera, (0, 1)),
    (renamed("action", "act"), (0, 1)),
    (renamed("observation.state", "observation.joints"), (0, 1)),
    (shaped("observation.state", [3]), (0, 1)),
    (shaped(CAM, [144, 128, 3]), (0, 1)),
    (shaped(CAM, [7200, 10_000, 3]), (0, 1)),
    (lambda root: (root / DATA).write_bytes(b"version https://git-lfs.github.com/spec/v1"), (0, 1)),
    (lambda root: edit(root / "meta/info.json", lambda c: c.update(fps=30)), (0, 1)),
    (lambda root: (root / DATA).unlink(), (0, 1)),
    (lambda root: (root / EPISODES_AT).write_bytes(b"PAR1"), (0, 1)),
    (column("length", 33), (0, 1)),
]


@pytest.mark.slow
@pytest.mark.parametrize(("trigger", "order"), TRIGGERS)
def test_the_printed_remedy_works_on_what_it_is_printed_for(datasets, copied, trigger, order):
    root = copied()
    trigger(root / EPISODES_AT if trigger is TRIGGERS[-1][0] else root)
    source, straight = as_printed(refused(root), root, datasets()), load_recordings(datasets(), CHUNK).samples[5]
    recordings = load_recordings(source, CHUNK)
    assert recordings.layout.action_order == order and len(recordings.samples) == 33
    assert np.array_equal(recordings.samples[5].chunk, straight.chunk[:, order])
    assert np.array_equal(recordings.samples[5].state, straight.state[list(recordings.layout.state_order)])
    if isinstance(source, Source) and source.action_names:
        result = CliRunner().invoke(main, ["inspect", str(root), "--action-names", ",".join(source.action_names)])
        assert result.exit_code == 0, result.output


@pytest.mark.slow
def test_one_of_a_folder_of_datasets_can_be_given_as_printed(copied, tmp_path):
    (tmp_path / "a/b").mkdir(parents=True)
    copied().rename(tmp_path / "a/b/image")
    for given in (tmp_path, tmp_path / "a/b", tmp_path / "a/b/image/data/chunk-000"):  # above or in it
        whole = re.search(r"(?:such as|give the whole:) (.+)$", refused(given))[1]
        assert len(load_recordings(whole, CHUNK).samples) == 33


@pytest.mark.slow
def test_without_a_state_it_is_the_last_action(copied):
    root = copied()
    column("observation.state")(root / DATA)
    edit(root / "meta/info.json", lambda c: c["features"].pop("observation.state"))
    recordings = load_recordings(root, CHUNK)
    assert "state: none recorded, taken as the last action" in recordings.layout.words()
    for episode in recordings.episodes:
        states = [s.state.tolist() for s in episode.samples]
        assert states == [[0, 0], *(s.chunk[0].tolist() for s in episode.samples[:-1])]


@pytest.mark.slow
def test_lerobots_way_decides_of_which_size_its_policys_pictures_are(trained, datasets, tmp_path):
    """A fine-tuned policy has its base's input_features, and LeRobot never resizes."""
    smaller = shutil.copytree(trained, tmp_path / "smaller")
    seen = "observation.images.cam_front"
    edit(smaller / "config.json", lambda c: c["input_features"][seen].update(shape=[3, 36, 128]))
    loaded, right = load(smaller, datasets()), load(trained, datasets())
    (note,) = loaded.checkpoint.report["notes"]
    assert "128x36" in note and "128x72" in note
    assert loaded.checkpoint.config == right.checkpoint.config and not right.checkpoint.report["notes"]
    sample = right.recordings.samples[0]
    assert np.array_equal(planned(loaded.checkpoint, sample), planned(right.checkpoint, sample))
    # of a smaller copy: nothing but a trial tells, and no plan of random weights is the better one
    edit(smaller / "config.json", lambda c: c["input_features"][seen].update(shape=[3, 36, 64]))
    copy = load(smaller, datasets()).checkpoint
    assert copy.config.image_sizes == ((36, 64),) and "tried on 8 frames" in copy.report["notes"][0]
    squeezed = replace(right.checkpoint.config, image_sizes=((36, 64),))
    write_lerobot(tmp_path / "ours", squeezed, right.checkpoint.weights, {})
    assert load(tmp_path / "ours", datasets()).checkpoint.config.image_sizes == ((36, 64),)  # squeezed on purpose


# ---- policies that were trained on one -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A LeRobot policy of two numbers that its dataset calls [throttle, steering], with statistics of both."""
    folder = tmp_path_factory.mktemp("trained")
    saved_normalised(lerobot_policy(**TINY), folder)
    return folder


def planned(checkpoint, sample):
    return predictions(ACT(checkpoint.config, checkpoint.weights), [inputs_of(sample, checkpoint.config)])[0].numpy()


def test_a_policy_is_put_into_the_recordings_order(trained):
    policy = load_checkpoint(trained)
    swapped = Layout(("cam_front",), rate_hz=20.0, state_order=(1, 0), action_order=(1, 0))
    other = policy.recorded_as(swapped)
    (sample,) = memory_samples(1)
    turned = replace(sample, state=np.ascontiguousarray(sample.state[::-1]))
    expected = planned(policy, sample)[:, ::-1]
    found = planned(other, turned)
    assert np.abs(found - expected).max() < 1e-6 < np.abs(found - expected[:, ::-1]).max()
    assert other.config.rate_hz == 20 and other.report["normalisation"]["state"] == "(state - (0.25, 0.3)) / (0.3, 1.2)"


def test_a_policy_of_other_numbers_or_another_rate_is_refused(trained, tiny):
    arm = Layout(("cam_front",), tuple("abcdef"), tuple("abcdef"), 30.0, tuple(range(6)), tuple(range(6)))
    with pytest.raises(CheckpointError, match="cameras, states and actions 1, 2, 2, found recordings of 1, 6, 6"):
        load_checkpoint(trained).recorded_as(arm)
    with pytest.raises(CheckpointError, match="30 steps a second, found recordings of 20 frames a second"):
        tiny.recorded_as(Layout(("cam_front",), rate_hz=20.0))
    assert tiny.recorded_as(Layout(("front",), rate_hz=30.0)) is tiny
    wheels, ours = ("left", "right"), ("steering", "throttle")
    for layout in (Layout(("front",), wheels, wheels, 30.0), Layout(("front",), wheels, ours, 30.0)):
        with pytest.raises(CheckpointError, match="state is left, right"):
            tiny.recorded_as(layout)


# ---- what is well-formed, and wrong ---------------------------------------------------------------------------------


def states_are(value):
    def change(rows):
        actions = np.stack(rows.column("action").to_pylist()).astype(np.float32)
        column = pyarrow.array(list(value(actions)), rows.column("observation.state").type)
        return rows.set_column(rows.column_names.index("observation.state"), "observation.state", column)

    return change


@pytest.mark.slow
@pytest.mark.parametrize(
    ("value", "words"),
    [
        (np.zeros_like, "steering and throttle: always 0"),
        (lambda actions: actions, "the action of the same row"),
        (lambda actions: actions * 100, "100 times the action of the same row"),
    ],
)
def test_a_state_that_is_not_the_last_action_is_replaced_by_it(copied, tmp_path, value, words):
    """And the dataset that the fault tells to write has it."""
    root = copied()
    right = [sample.state for sample in load_recordings(root, CHUNK).samples]
    table(root / DATA, states_are(value))
    recordings = load_recordings(root, CHUNK)
    (fault,) = recordings.faults
    assert words in fault.note and fault.handled == "replaced by the last action" and fault.count == EPISODES
    assert recordings.cautions() and np.array_equal([sample.state for sample in recordings.samples], right)
    command = re.search("rover export-dataset", fault.note)[0].split()[1:]
    assert CliRunner().invoke(main, [*command, str(root), str(tmp_path / "out")]).exit_code == 0
    written_anew = load_recordings(tmp_path / "out", CHUNK)
    assert not written_anew.faults and np.array_equal([sample.state for sample in written_anew.samples], right)


@pytest.mark.slow
@pytest.mark.parametrize("data", [bytes(600), bytes(range(1, 201)) * 3])
def test_a_video_that_is_torn_in_its_middle_costs_its_own_pictures(copied, data):
    root = copied("video")
    whole = (root / VIDEO_AT).read_bytes()
    middle = len(whole) // 2
    (root / VIDEO_AT).write_bytes(whole[:middle] + data + whole[middle + len(data) :])
    recordings = load_recordings(root, CHUNK)
    (fault,) = recordings.faults
    assert fault.kind == "broken_picture" and 2 <= fault.count == EPISODES * FRAMES + 3 - len(recordings.samples) <= 16
    for sample in recordings.samples:
        sample.frame_bgr()  # each that is left can be decoded


@pytest.mark.slow
def test_times_that_are_not_quite_those_of_a_videos_pictures_are_repaired_or_named(copied):
    root = copied("video")
    right = [sample.frame_bgr() for sample in load_recordings(root, CHUNK).samples]
    at = f"videos/{CAM}/from_timestamp"

    def shifted(by_s):
        def change(rows):
            times = rows.column(at).to_pylist()
            times[1] += by_s
            return rows.set_column(rows.column_names.index(at), at, pyarrow.array(times, rows.column(at).type))

        return change

    table(root / EPISODES_AT, shifted(2e-4))
    recordings = load_recordings(root, CHUNK)
    assert [(fault.kind, fault.handled) for fault in recordings.faults] == [("other_times", "repaired")]
    assert "episode 1: from_timestamp is 0.2 ms off" in recordings.faults[0].note
    for sample, picture in zip(recordings.samples, right, strict=True):
        assert np.array_equal(sample.frame_bgr(), picture)
    table(root / EPISODES_AT, shifted(0.02))
    assert "episode 1: from_timestamp is 20 ms off" in refused(root)


def test_another_programs_info_is_called_so(tmp_path):
    assert "another program's meta/info.json" in refused(written(tmp_path, {"name": "my robot", "license": "mit"}))
