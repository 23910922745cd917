"""The slider over frames, and figures that need no policy: what they show of what they are given."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from rover_lib.workshop import explorer, plots, progress
from rover_lib.workshop.plots.style import Drawn, Note

RESULTS = Path(__file__).parents[2] / "results"


def samples(count=3):
    made = []
    for i in range(count):
        picture = np.full((72, 128, 3), 80 * i, np.uint8)
        chunk = np.full((4, 2), 0.1 * i, np.float32)
        facts = {"episode": "e", "time_s": i / 30, "chunk": chunk, "is_pad": np.zeros(4, bool)}
        made.append(SimpleNamespace(frame_bgr=lambda p=picture: p, state=np.zeros(2), **facts))
    return made


def policy(strange):
    return SimpleNamespace(strange=strange, predict_chunk=lambda frame, state: np.full((4, 2), frame.mean() / 1000))


RANGES = {"steering": (-1.0, 1.0), "throttle": (0.0, 1.0)}


def test_outside_jupyterlab_one_frame_is_a_figure(monkeypatch):
    monkeypatch.delenv("JPY_SESSION_NAME", raising=False)
    shown = explorer.explore(samples(), {"static": policy(0.25)}, RANGES)
    assert isinstance(shown, Drawn)
    picture, steering, _ = shown.axes
    assert "static 0.25" in picture.get_title()
    driver, static = (line.get_ydata() for line in steering.get_lines())
    assert driver == pytest.approx(0.1) and static == pytest.approx(0.08)


def test_the_slider_changes_the_picture(monkeypatch):
    monkeypatch.setenv("JPY_SESSION_NAME", "01_load.ipynb")
    box = explorer.explore(samples(), {}, RANGES)
    (play, slider), image = box.children[0].children, box.children[1]
    assert (play.max, slider.max) == (2, 2)
    first = image.value
    slider.value = 2
    assert image.value != first
    slider.value = 0
    assert image.value == first


def test_a_notebooks_bar_leaves_no_widget_behind(monkeypatch):
    monkeypatch.setenv("JPY_SESSION_NAME", "01_load.ipynb")
    shown = []
    handle = SimpleNamespace(update=lambda html: shown.append(html.data))
    monkeypatch.setattr("IPython.display.display", lambda html, display_id: shown.append(html.data) or handle)
    monkeypatch.setattr(progress, "EVERY_S", -1)
    assert list(progress.notebook_bar()(range(3), desc="a < b")) == [0, 1, 2]
    assert shown[0] == "a &lt; b" and shown[-1] == ""
    assert '<progress value="2" max="3">' in shown[3] and "2 of 3" in shown[3]


def metrics(path):
    return json.loads((RESULTS / path).read_text())["metrics"]


def test_stored_results_are_drawn():
    counted, judged = metrics("full/arm.json"), metrics("full/students.json")["students"]
    bars = plots.kernels(counted).axes[-1]
    total = sum(bar.get_width() for bar in bars.patches)
    assert total == pytest.approx(counted["artifacts"]["policy_static"]["instructions_g"], rel=0.01)
    assert isinstance(plots.kernels({}), Note)
    errors, _ = plots.students(judged).axes
    assert [line.get_label() for line in errors.get_lines()] == ["steering", "throttle"]
    left, _, _ = plots.hits_by_round(metrics("demo/learn.json")["policies"]).axes
    assert left.containers[0].lines[0].get_ydata()[-1] == pytest.approx(90.5)
    _, pushed = plots.hits_over_lateness(metrics("demo/drive.json")["rows"]).axes
    assert pushed.containers[0].lines[0].get_ydata() == pytest.approx([95, 77.5, 62.5])
    benchmark = json.loads((RESULTS / "demo" / "benchmark-vm.json").read_text())
    figure = plots.latencies({"this machine": benchmark}, 500, {"the demo's": (3, 6)})
    assert figure.axes[0].get_yticklabels()[-1].get_text() == "the demo's, Pi 5, computed"


def test_two_artifacts_paths_are_compared():
    path = np.stack([np.linspace(0, 2, 30), np.zeros(30)], 1)
    trials = {}
    for mode, aside in (("fp32", 0.0), ("static", 0.01)):
        trials[mode] = SimpleNamespace(trials=1, paths=(path + np.array([0, aside]),), balloons=((2.0, 0.0),))
    _, apart = plots.paths(trials).axes
    assert apart.get_lines()[0].get_ydata() == pytest.approx(1.0)  # cm
    assert isinstance(plots.paths({}), Note)
