"""The comparison gives the values that were computed by hand."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from rover_lib.onboard.car.car import Car
from rover_lib.onboard.errors import PolicyError
from rover_lib.onboard.stage import plain
from rover_lib.workshop import plots
from rover_lib.workshop.judge import compare
from rover_lib.workshop.plots.style import Note

CHUNK = 3
RANGE = {"steering": (-0.2, 0.6), "throttle": (0.0, 0.1)}
LIMITS = {
    "error_ms": 20, "error_ms_no_less_steering": 40, "error_pct": 1.0, "worlds_lost_pct": 2, "fp32_hits": 36,
    "size_mb": {"static": 70, "dynamic": 110},
}  # fmt: skip


class Fixed:
    """A policy that plans `base`, and adds off[k] in its k-th call."""

    chunk = CHUNK

    def __init__(self, base, off=None, names=("steering", "throttle"), car=None):
        self.base, self.off, self.action_names, self.car = np.float32(base), off, names, car or Car()
        self.calls = 0

    def predict_chunk(self, frame_bgr, state):
        off = 0 if self.off is None else self.off[self.calls]
        self.calls += 1
        return self.base + np.float32(off)


def sample(pads=0):
    seen = {"frame_bgr": lambda: np.zeros((4, 6, 3), np.uint8), "state": np.zeros(2, np.float32)}
    did = {"chunk": np.zeros((CHUNK, 2), np.float32), "is_pad": np.arange(CHUNK) >= CHUNK - pads}
    return SimpleNamespace(**seen, **did, episode="episode", frame_name="frame_000001.jpg")


@pytest.fixture
def report():
    """Static INT8's steering is 0.008 off (1 % of its range) in frame 2's first step, its throttle 0.001 everywhere."""
    base = [[0.1, 0.05], [0.2, 0.05], [0.3, 0.05]]
    off = [np.full((3, 2), [0, 0.001]), np.float64([[0.008, 0.001], [0, 0.001], [0, 0.001]])]
    return compare.fidelity(Fixed(base), {"static": Fixed(base, off)}, [sample(), sample(pads=2)], RANGE)


def test_errors_by_hand(report):
    first, second = report.worst("static", 5)
    assert first.sample is report.samples[0] and second.sample is report.samples[1] and first.action == "throttle"
    assert first.error_pct == pytest.approx(1.0, rel=1e-4)
    found = report.summary("static")
    assert found["steering_mae_pct"] == pytest.approx(0.008 / 6 / 0.8 * 100, rel=1e-4)
    assert found["throttle_mae_pct"] == pytest.approx(1.0, rel=1e-4)
    assert found["steering_max_pct"] == pytest.approx(1.0, rel=1e-4)
    assert found["steering_mae_per_step_pct"] == pytest.approx([0.5, 0, 0], abs=1e-4)
    assert found["steering_less_pct"] == pytest.approx(-found["steering_mae_pct"])  # it steers more
    assert report.relative("static") == pytest.approx(0.008, rel=1e-4)  # of 1, as no plan is larger


def test_padded_steps_do_not_count_against_the_recording(report):
    assert report.is_pad.sum() == 2
    # FP32 against a recorded (0, 0): the steps 0.1, 0.2, 0.3 of frame 1, and 0.1 of frame 2
    recorded = report.recorded_error(report.reference)
    assert recorded["steering_vs_recorded_pct"] == pytest.approx(0.7 / 4 / 0.8 * 100, rel=1e-4)


def test_an_error_is_also_the_delay_that_moves_the_plan_as_far():
    """A policy that always plans nearly the same was once 0.01 % off, and so passed every gate."""
    found = metrics_of(worst_tenth_pct=0.03)
    assert compare.error_ms(found, "static") is None  # no picture is known to move a plan
    looking = {"looking": {"steering_by_100_ms_pct": 0.1, "throttle_by_100_ms_pct": None, "frames": 3}}
    found |= looking
    assert compare.error_ms(found, "static") == pytest.approx(30)
    rows = {r["gate"]: r["passed"] for r in compare.gates(found, LIMITS)}
    assert rows["static error, ms of delay"] is False and not any(IN_PCT in gate for gate in rows)
    for less_pct, passed in ((0.1, False), (0.0, True), (-0.1, True)):  # those that lost worlds steered less
        found["modes"]["static"]["steering_less_pct"] = less_pct
        assert compare.gates(found, LIMITS)[0]["passed"] is passed
    worse = metrics_of(worst_tenth_pct=0.05, steering_less_pct=-0.1) | looking
    assert compare.gates(worse, LIMITS)[0]["passed"] is False


def test_the_worst_tenth_and_the_highest_errors_by_hand():
    """Of twenty frames, the k-th's first step steers k thousandths off, as does every fourth throttle."""
    base = np.full((CHUNK, 2), 0.05)
    off = [np.float64([[0.001 * k, 0], [0, 0], [0, 0.001 * (k % 4 == 0)]]) for k in range(20)]
    found = compare.fidelity(Fixed(base), {"static": Fixed(base, off)}, [sample()] * 20, RANGE).summary("static")
    both = 100 * (0.016 + 0.012) / 2 / 3 / 0.8 + 100 * 0.001 / 3 / 0.1  # of frames 12 and 16, both actions together
    assert found["worst_tenth_pct"] == pytest.approx(both, rel=1e-3)
    steering = np.float64([0.001 * k for k in range(20)] + [0] * 40)
    assert found["steering_p95_pct"] == pytest.approx(100 * np.quantile(steering, 0.95) / 0.8, rel=1e-3)
    assert found["throttle_mae_per_step_pct"] == pytest.approx([0, 0, 100 * 0.001 / 4 / 0.1], rel=1e-3, abs=1e-4)


@pytest.mark.filterwarnings("error")
def test_an_action_that_never_changed_is_neither_judged_nor_drawn(policies):
    """The recordings' throttle never changes, but static INT8's is 0.001 off."""
    base, off = np.full((3, 2), 0.05), [np.full((3, 2), [0.008, 0.001])]
    report = compare.fidelity(Fixed(base), {"static": Fixed(base, off)}, [sample()], RANGE | {"throttle": (0.04, 0.04)})
    metrics = compare.metrics(report, policies)
    static = metrics["modes"]["static"]
    shares = {k: v for k, v in static.items() if k.startswith("throttle") and k.endswith("_pct")}
    assert len(shares) == 6 and set(shares.values()) == {None} and "NaN" not in json.dumps(plain(metrics["modes"]))
    assert metrics["fp32"]["throttle_vs_recorded_pct"] is None and len(metrics["warnings"]) == 1
    assert [w.action for w in report.worst("static")] == ["steering"]
    rows = {r["gate"]: r["passed"] for r in compare.gates(metrics, LIMITS)}
    assert rows["fp32 hits"] is rows["static worlds lost at most, %"] is None  # nor driven
    error = plots.action_error(report)
    for figure in (error, plots.worst_frames(report, count=1)):
        figure.draw_without_rendering()
    steering, throttle = (ax for ax in error.axes if ax.get_title())
    assert steering.get_lines() and not throttle.get_lines() and len(throttle.texts) == 1
    seen, least = sample(), {"episode": "episode", "row": 5, "strange": 1.0}
    seen.row = 5
    plots.familiarity({"largest": {"a": 0.5, "b": 1.0}, "least": [least] * 2}, [seen]).draw_without_rendering()
    nothing = replace(report, action_range={"steering": (0.1, 0.1), "throttle": (0.0, 0.0)})
    assert nothing.worst("static") == []
    assert isinstance(plots.familiarity({}, []), Note)
    assert isinstance(plots.action_error(nothing), Note) and isinstance(plots.worst_frames(nothing), Note)


def test_refusals(tmp_path):
    policy, another = (Fixed(np.zeros((3, 2)), names=names) for names in (("steering", "throttle"), ("a", "b")))
    for other, samples, ranges in (
        (policy, [], RANGE),
        (another, [sample()], RANGE),  # of another checkpoint
        (policy, [sample()], {"steering": (0, 1)}),
    ):
        with pytest.raises(PolicyError):
            compare.fidelity(policy, {"static": other}, samples, ranges)
    with pytest.raises(PolicyError):
        compare.load_policies(tmp_path)  # no FP32 is there


@pytest.fixture
def policies(tmp_path):
    made = {}
    for mode, size in (("fp32", 4_000_000), ("static", 1_000_000)):
        path = tmp_path / f"policy_{mode}.pt"
        path.write_bytes(bytes(size))
        made[mode] = SimpleNamespace(path=path, manifest={"weights_mb": size / 1e6})
    return made


def test_metrics_say_sizes_hits_and_pairs(report, policies):
    trials = {}
    for mode, last in (("fp32", True), ("static", False)):
        trials[mode] = SimpleNamespace(hits=39 + last, trials=40, hit=(*[True] * 39, last))
    found = compare.metrics(report, policies, trials)
    static = found["modes"]["static"]
    assert (static["hits"], static["trials"], static["size_mb"]) == (39, 40, 1.0)
    assert (static["pairs"]["only_first"], static["pairs"]["only_second"]) == (1, 0)
    assert found["fp32"]["hits"] == 40


def pairs_of(lost, won, worlds=40):
    first, second = [True] * worlds, [True] * worlds
    second[:lost], first[lost : lost + won] = [False] * lost, [False] * won
    return {"pairs": compare.compare_pairs(first, second)}


def metrics_of(**changed):
    static = {"steering_mae_pct": 0.3, "throttle_mae_pct": 0.7, "size_mb": 66.4} | pairs_of(2, 0) | changed
    return {"fp32": {"hits": 40, "trials": 40}, "modes": {"static": static, "dynamic": static}}


IN_PCT = "error, % of the recorded range"


@pytest.mark.parametrize(
    ("changed", "failing"),
    [
        ({}, set()),
        ({"throttle_mae_pct": 1.01}, {f"static {IN_PCT}"}),
        ({"throttle_mae_pct": 1.0}, set()),  # exact at the limit
        ({"steering_mae_pct": 5.5}, {f"static {IN_PCT}"}),
        (pairs_of(5, 0), set()),  # p = 0.06: neither shown to be as good nor to lose
        (pairs_of(6, 0), {"static worlds lost at most, %"}),
        (pairs_of(0, 9), set()),  # it is better
        ({"size_mb": 266.0}, {"static size_mb"}),
    ],
)
def test_gates(changed, failing):
    rows = compare.gates(metrics_of(**changed), LIMITS)
    assert {r["gate"] for r in rows if r["passed"] is False} == failing
    assert compare.gates(metrics_of(size_mb=102.0), LIMITS, "dynamic")[-1]["passed"]  # each mode has its own size
    assert [compare.hits_needed(LIMITS, trials) for trials in (None, 40, 20)] == [36, 36, 18]


def test_worlds_decide_where_they_show_something():
    """200 worlds without a loss show that at most 2 % are lost; whatever the error, they are what the car does."""
    found = metrics_of(throttle_mae_pct=2.0, **pairs_of(0, 0, 200))
    found["fp32"] |= {"hits": 200, "trials": 200}
    rows = {r["gate"]: r["passed"] for r in compare.gates(found, LIMITS)}
    assert rows["static worlds lost at most, %"] is True and not any(IN_PCT in gate for gate in rows)
    found["modes"]["static"] |= pairs_of(1, 0, 200)  # does not show it
    rows = {r["gate"]: r["passed"] for r in compare.gates(found, LIMITS)}
    assert rows["static worlds lost at most, %"] is None and rows[f"static {IN_PCT}"] is False
