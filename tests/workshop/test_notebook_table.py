"""Tables for notebooks: their cells can be copied, and their content is text."""

import io
import json
import re
from base64 import b64decode
from pathlib import Path

from PIL import Image

from rover_lib.onboard.care.limits import check_gates
from rover_lib.onboard.params import params
from rover_lib.workshop import browse, plots
from rover_lib.workshop.judge.compare import gate
from rover_lib.workshop.judge.verdict import gate_in_words
from rover_lib.workshop.notebook_table import Table
from rover_lib.workshop.plots.style import Drawn, Note, new_figure
from rover_lib.workshop.progress import TTY_VARIABLE

RESULTS = Path(__file__).parents[2] / "results"


def test_html_and_text_say_the_same():
    table = Table(("what", "MB"), [("a < b", "1.0"), ("c", "20.0")], caption="sizes & more", notes=("measured here",))
    html = table._repr_html_()
    assert re.findall(r"<td[^>]*>(.*?)</td>", html) == ["a &lt; b", "1.0", "c", "20.0"]
    assert "sizes &amp; more" in html and "measured here" in html
    assert str(table).splitlines() == ["sizes & more", "what     MB", "a < b   1.0", "c      20.0", "measured here"]


def test_gates_are_in_words_with_a_shade_for_each():
    rows = [
        gate("static throttle_mae_pct", 0.14, "<=", 1),
        gate("static hits lost", 3, "<=", 2),
        gate("policy_static_180x320 instructions_g", None, "<=", 0.44),
        gate("fast worlds lost, pushed, %", 0.0, "<=", 0),
        gate("policy_static.onnx error on the emulated core, times torch's there", 1.01, "<=", 1.1),
    ]
    table = plots.gates(rows)
    assert [row[0] for row in table.rows] == [
        "throttle error of static INT8, % of the recorded range",
        "balloons that static INT8 misses and FP32 hits",
        "instructions of a plan of static INT8 at 320x180, 10^9",
        "fast worlds lost, pushed, %",
        "error on the emulated core, times torch's there, of static INT8 for ONNX Runtime",
    ]
    assert [row[-1] for row in table.rows] == ["kept", "MISSED", "not measured", "kept", "kept"]
    assert table.caption == "3 of 5 promises kept, 1 missed, 1 not measured"
    assert len(set(table.shades)) == 3 and table._repr_html_().count("background") == 5


def test_each_of_the_originals_promises_has_words():
    rows = check_gates({}, params()["gates"]["original"])
    assert not [row["gate"] for row in rows if gate_in_words(row["gate"]) == row["gate"]]


def test_no_gate_of_the_repository_is_shown_as_a_key():
    names = set()
    for path in RESULTS.rglob("*.json"):
        metrics = json.loads(path.read_text())["metrics"]
        found = [*metrics.get("gates", []), *metrics.get("recommendation", {}).get("gates", [])]
        names |= {row["gate"] for row in found if isinstance(row, dict)}
    assert len(names) > 10
    assert not [name for name in names if "_" in gate_in_words(name)]


def test_a_figure_is_shown_with_twice_the_pixels_at_its_size():
    figure, _ = new_figure(1, height_in=2.0)
    assert isinstance(figure, Drawn)
    data, metadata = figure._repr_mimebundle_()
    assert metadata["image/png"] == {"width": 900, "height": 200} and set(data) == {"image/png"}
    assert Image.open(io.BytesIO(b64decode(data["image/png"]))).size == (1800, 400)


def test_a_sentence_leaves_no_figure_and_takes_an_old_one_away(tmp_path):
    old = tmp_path / "figures" / "01_faults.png"
    old.parent.mkdir()
    old.touch()
    assert repr(plots.save(Note("no faults"), tmp_path, "01_faults")) == "no faults"
    assert not old.exists()


def test_a_slider_is_for_somebody_who_can_move_it(monkeypatch):
    drawn = []
    monkeypatch.delenv("JPY_SESSION_NAME", raising=False)
    monkeypatch.delenv(TTY_VARIABLE, raising=False)
    assert browse.browse(3, drawn.append) is None  # as under papermill and nbval
    monkeypatch.setenv("JPY_SESSION_NAME", "/notebooks/01_load.ipynb")
    slider, _ = browse.browse(3, drawn.append, "tick").children
    assert (slider.min, slider.max, slider.description) == (0, 2, "tick") and drawn == [0]
    slider.value = 2
    assert drawn == [0, 2]
    assert browse.browse(0, drawn.append) is None
    monkeypatch.setenv(TTY_VARIABLE, "/dev/pts/0")  # as in `rover run` from a terminal in JupyterLab
    assert browse.browse(3, drawn.append) is None
