"""A teacher and its students side by side: rows, what is kept, and what is refused."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from balloon_world import drives, students
from balloon_world.drives import SEED
from balloon_world.students import gates_of, judge_students, recommendation, table
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.params import params
from rover_lib.onboard.stage import read_stage, sha256_of, write_stage
from tests.helpers.recorded import record_drives


class Policy:
    """Plans the same always, so much off; hits where its seed is large enough."""

    chunk = 32

    def __init__(self, path, threads):
        assert threads == 1
        self.given = json.loads(path.read_text())

    def predict_chunk(self, frame_bgr, state):
        return np.full((self.chunk, 2), self.given["off"], np.float32)


def artifact(path, checkpoint, off=0.0, misses=0, gmac=15.0, height=360):
    """An artifact as the tests read it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    camera = {"name": "cam_front", "height": height, "width": 640}
    given = {"checkpoint": {"sha256": checkpoint}, "gmac": gmac, "cameras": [camera], "chunk": 32}
    path.write_text(json.dumps(given | {"off": off, "misses": misses}))


def shape(name, layers):
    return {"name": name, "decoder_layers": layers, "feedforward": 1600}


def distilled(folder, teacher="teacher's", own="student's"):
    found = {"students": [shape("teacher", 7), shape(folder.name, 2)], "losses": {"together": [2.0, 1.0]}}
    found["files_sha256"] = {"best_model.pth": own}
    write_stage(folder / "distill.json", "distill", params={}, metrics=found, inputs={"best_model.pth": teacher})


def counted(folder, high_ms, **changed):
    """Write counts of work that takes a Pi 5 at most that time."""
    counts = {"instructions_g": high_ms / 100, "simd_g": high_ms / 90} | changed
    counts |= {"computed_pi5_ms": {"low": high_ms / 2, "ms": high_ms / 1.4, "high": high_ms, "threads": 3}}
    inputs = {"policy_static.pt": sha256_of(folder / "policy_static.pt")}
    metrics = {"artifacts": {"policy_static": counts}}
    write_stage(folder / "arm.json", "arm", params={}, metrics=metrics, inputs=inputs)


@pytest.fixture
def made(tmp_path, monkeypatch):
    """A teacher's run and a student's, and the drives that were driven: (off, kind, seed, latency)."""
    monkeypatch.setenv("ROVER_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(drives, "load_policy", Policy)
    monkeypatch.setattr(students, "content_hash", sha256_of)
    monkeypatch.setattr(students, "read_manifest", lambda path: json.loads(path.read_text()))
    driven = []

    def drive_once(policy, seed, late_ms, settings, level):
        driven.append((policy.given["off"], seed, late_ms))
        return "hit" if seed >= SEED + policy.given["misses"] else "left"

    monkeypatch.setattr(students, "drive_once", drive_once)
    teacher, student = tmp_path / "full", tmp_path / "fast"
    artifact(teacher / "policy_fp32.pt", "teacher's")
    artifact(teacher / "policy_static.pt", "teacher's", off=0.001)
    artifact(student / "policy_static.pt", "student's", off=0.002, misses=1, gmac=3.0, height=180)
    distilled(student)
    write_stage(
        teacher / "load.json", "load", params={"episodes": str(record_drives(tmp_path / "episodes"))}, metrics={}
    )
    return SimpleNamespace(teacher=teacher, student=student, driven=driven)


def test_rows_are_of_both_and_each_is_as_late_as_computed_for_it(made):
    counted(made.teacher, 90)
    counted(made.student, 20)
    content = judge_students(made.teacher, [made.student], worlds=3)
    assert content == read_stage(made.teacher / "students.json", "students")
    teacher, student = content["metrics"]["students"]
    assert set(teacher) == set(student)
    assert (teacher["name"], teacher["decoder_layers"], teacher["computed_ms"][1]) == ("teacher", 7, pytest.approx(90))
    assert (student["name"], student["height"], student["decoder_layers"]) == ("fast", 180, 2)
    assert (student["hits"], student["trials"], student["missed"]) == (2, 3, [SEED])
    assert (student["pushed_hits"], student["pushed_latency_ms"]) == (2, pytest.approx(20))
    assert teacher["hits"] == teacher["pushed_hits"] == 3 and teacher["hits_wilson_high"] == 1
    assert 0 < teacher["teacher_throttle_pct"] < student["teacher_throttle_pct"]  # to FP32, which is 0 off
    assert student["teacher_throttle_pct"] == pytest.approx(2 * teacher["teacher_throttle_pct"], rel=1e-3)
    assert {late and round(late, 6) for *_, late in made.driven} == {None, 90, 20}
    assert content["metrics"]["recommendation"]["name"] == "teacher"


def test_what_was_driven_once_is_kept(made):
    first = judge_students(made.teacher, [made.student], worlds=2)["metrics"]
    assert len(made.driven) == 8
    made.driven.clear()
    assert judge_students(made.teacher, [made.student], worlds=2)["metrics"] == first and not made.driven
    artifact(made.student / "policy_static.pt", "student's", off=0.004)
    judge_students(made.teacher, [made.student], worlds=3)  # one more world for each, and all for another artifact
    assert len(made.driven) == 2 + 6 and {seed for off, seed, _ in made.driven if off != 0.004} == {SEED + 2}
    made.driven.clear()
    judge_students(made.teacher, [made.student], worlds=1, level="hard")  # nor does a level answer for another
    assert len(made.driven) == 4


def test_where_there_is_no_world_nobody_drives(made):
    found = judge_students(made.teacher, [made.student], worlds=0)["metrics"]
    assert not made.driven and found["notes"][0].startswith("Nobody drove")
    assert all(row["hits"] is row["trials"] is row["pushed_latency_ms"] is None for row in found["students"])


@pytest.mark.parametrize("wrong", [{"teacher": "another"}, {"own": "another"}, None])
def test_what_does_not_belong_together_is_refused(made, wrong):
    if wrong:
        distilled(made.student, **wrong)
    student = made.student if wrong else made.student.rename(made.student.with_name("teacher"))
    with pytest.raises(RoverError):
        judge_students(made.teacher, [student], worlds=1)
    assert not (made.teacher / "students.json").exists()


LIMITS = params()["students"]
FULL = Path(__file__).parents[2] / "results" / "full" / "students.json"
TEACHER = read_stage(FULL, "students")["metrics"]["students"][0]  # hits 200 of 200, and 181 pushed
NOT_DRIVEN = {key: None for key in TEACHER if "hits" in key or "trials" in key}


def row(name, **changed):
    """A policy that is like the teacher, but for what is changed."""
    return TEACHER | {"name": name} | changed


@pytest.mark.parametrize(
    ("changed", "passed"),
    [
        ({"hits": 196, "recorded_steering_pct": 6.8}, [True, True, True]),
        ({"hits": 195, "pushed_hits": 180}, [False, False, True]),
        ({"recorded_steering_pct": 4.0, "recorded_throttle_pct": 7.95}, [True, True, False]),
        ({"pushed_hits": None, "pushed_trials": None}, [True, None, True]),
    ],
)
def test_each_limit_is_held(changed, passed):
    assert [g["passed"] for g in gates_of(row("s", **changed), TEACHER, LIMITS)] == passed
    name = recommendation([TEACHER, row("s", **changed)], LIMITS)["name"]
    assert name == ("s" if all(passed) else "teacher")


def test_the_fastest_of_those_within_the_limits_is_recommended():
    slow, fast = row("slow", instructions_g=0.5, gmac=1.0), row("fast", instructions_g=0.3)
    wrong = row("wrong", instructions_g=0.1, gmac=0.1, hits=190)
    verdict = recommendation([TEACHER, slow, fast, wrong], LIMITS)
    assert (verdict["name"], verdict["fastest_by"], len(verdict["gates"])) == ("fast", "instructions_g", 9)
    rows = [TEACHER, slow | {"instructions_g": None, "computed_ms": None}, fast, wrong]
    verdict = recommendation(rows, LIMITS)
    assert verdict["name"] == "slow"  # then by multiply-accumulates
    shown = str(table({"students": rows, "recommendation": verdict, "notes": ["a note"], "warnings": []}))
    assert "params.yml: slow" in shown and "not counted" in shown and "181 of 200 at 89 ms" in shown


def test_where_nobody_drove_errors_decide():
    teacher, student = row("teacher", **NOT_DRIVEN), row("s", **NOT_DRIVEN | {"recorded_throttle_pct": None})
    verdict = recommendation([teacher, student], LIMITS)
    assert verdict["name"] == "s" and len(verdict["gates"]) == 1
    assert recommendation([teacher, student | {"recorded_steering_pct": 9.0}], LIMITS)["name"] == "teacher"
