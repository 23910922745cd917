"""Datasets that somebody made to hurt: each ends in a sentence, within 5 s of processor time and 500 MB."""

import io
import json
import os
import shutil
import signal

import numpy as np
import pyarrow as pa
import pytest
import torch
from PIL import Image
from pyarrow import parquet
from test_lerobot_dataset import make

from rover_lib.onboard.errors import EpisodeError
from rover_lib.workshop.recordings.episodes import load_recordings

MOST_S, MOST_MB = 5.0, 500
DATA, EPISODES = "data/chunk-000/file-000.parquet", "meta/episodes/chunk-000/file-000.parquet"
TASKS, STATS, INFO, KEY = "meta/tasks.parquet", "meta/stats.json", "meta/info.json", "observation.images.cam_front"


def is_fifo(name):
    return lambda root: ((root / name).unlink(), os.mkfifo(root / name))


def is_linked(root):
    folder = (root / DATA).parent
    folder.rename(root / "elsewhere")
    folder.symlink_to(root / "elsewhere")
    is_fifo(DATA)(root)


def says(**changes):
    def change(root):
        content = json.loads((root / INFO).read_text())
        content["features"][KEY] |= changes.pop("camera", {})
        (root / INFO).write_text(json.dumps(content | changes))

    return change


def rows(name, count, without=()):
    """The first row again and again, which takes no room in a file."""

    def change(root):
        table = parquet.read_table(root / name)
        columns = {}
        for field in table.schema:
            if not field.name.startswith(without or ("-",)):
                value = pa.array([table.column(field.name)[0].as_py()], field.type)
                columns[field.name] = value.take(pa.array(np.zeros(count, np.int32)))
        parquet.write_table(pa.table(columns), root / name, compression="zstd", row_group_size=count)

    return change


def column(name, make_value):
    def change(root):
        table = parquet.read_table(root / DATA)
        values = [make_value(value) for value in table.column(name).to_pylist()]
        kind = pa.list_(pa.float32()) if name == "observation.state" else table.schema.field(name).type
        index = table.column_names.index(name)
        parquet.write_table(table.set_column(index, name, pa.array(values, kind)), root / DATA, compression="zstd")

    return change


def make_bomb():
    Image.new("RGB", (9000, 9000)).save(buffer := io.BytesIO(), "PNG")
    return buffer.getvalue()


BOMB = make_bomb()
HOSTILE = {
    **{f"a pipe as {name}": is_fifo(name) for name in (DATA, EPISODES, TASKS, STATS)},
    "a pipe in a folder that is a link": is_linked,
    "a wide data_path": says(data_path="data/{chunk_index:4000000000d}.parquet"),
    "a wide video_path": says(video_path="videos/{video_key:>4000000000}.mp4"),
    "a data_path that leads out": says(data_path="../../etc/{chunk_index}"),
    "a data_path that looks into objects": says(data_path="{chunk_index.__class__}"),
    "a billion episodes": says(total_episodes=10**9),
    "a rate of nothing": says(fps=1e-300),
    "pictures without end": says(camera={"shape": [10_000, 10_000, 3]}),
    "pictures of another size": says(camera={"shape": [4000, 4000, 3]}),
    "frames without end": rows(DATA, 3_000_000, ("observation.images",)),
    "episodes without end": rows(EPISODES, 300_000),
    "tasks without end": rows(TASKS, 5_000_000),
    "a state without end": column("observation.state", lambda _: [0.0] * 2_000_000),
    "a picture by its path": column(KEY, lambda _: {"bytes": None, "path": "/etc/hostname"}),
    "no picture at all": column(KEY, lambda _: None),
    "a picture that is a bomb": column(KEY, lambda _: {"bytes": BOMB, "path": "x.png"}),
    "pictures of zeros": column(KEY, lambda _: {"bytes": bytes(30_000_000), "path": "x.png"}),
    "brackets without end": lambda root: (root / STATS).write_text("[" * 200_000),
    "numbers without end": lambda root: (root / STATS).write_text("[" + "0," * 20_000_000 + "0]"),
}


def in_a_child(work):
    """Do it in a process of its own, which takes its memory with it. Returns its exit code, seconds and megabytes."""
    if not (child := os.fork()):
        code = 9
        signal.alarm(60)
        torch.set_num_threads(1)  # a fork has none of the threads that OpenMP began before, and would wait
        try:
            code = work() or 0
        finally:
            os._exit(code)
    _, status, used = os.wait4(child, 0)
    return os.waitstatus_to_exitcode(status), used.ru_utime + used.ru_stime, used.ru_maxrss / 1e3


@pytest.mark.slow
def test_23_hostile_datasets(tmp_path):
    """One unpacked 0.97 MB to 3.5 GB, one filled in a template for 42 s, one waited for a pipe for ever."""
    good = make(tmp_path / "good", "image")
    os.mkfifo(good / "beside.parquet")
    wrong = [] if in_a_child(lambda: load_recordings(good, 8) and None)[0] == 0 else ["what lies beside is read"]
    (good / "beside.parquet").unlink()
    wrong += [] if len(HOSTILE) == 23 else [f"{len(HOSTILE)} datasets"]

    def refuse(root):
        try:
            load_recordings(root, 8)
        except EpisodeError:
            return 0
        return 1

    for name, spoil in HOSTILE.items():
        root = shutil.copytree(good, tmp_path / "hostile")
        assert in_a_child(lambda spoil=spoil, root=root: spoil(root) and None)[0] == 0
        before_mb = in_a_child(int)[2]
        code, seconds, mb = in_a_child(lambda root=root: refuse(root))
        print(f"{name:36} {code} {seconds:.1f} s {mb - before_mb:.0f} MB")
        if code or seconds > MOST_S or mb - before_mb > MOST_MB:
            wrong.append(f"{name}: {code}, {seconds:.1f} s, {mb - before_mb:.0f} MB")
        shutil.rmtree(root)
    assert not wrong, "\n".join(wrong)
