"""Tables and figures of notebooks: cells can be copied."""

import re

from rover_lib.onboard.params import params
from rover_lib.workshop import plots
from rover_lib.workshop.notebook_table import Table
from rover_lib.workshop.plots.style import Note


def test_html_and_text_say_the_same():
    table = Table(("what", "MB"), [("a < b", "1.0"), ("c", "20.0")], caption="sizes & more", notes=("measured here",))
    html = table._repr_html_()
    assert re.findall(r"<td[^>]*>(.*?)</td>", html) == ["a &lt; b", "1.0", "c", "20.0"]
    assert "sizes &amp; more" in html and "measured here" in html
    assert str(table).splitlines() == ["sizes & more", "what     MB", "a < b   1.0", "c      20.0", "measured here"]


def test_gates_of_the_original():
    metrics = {"latency_mean_ms": 41.0, "latency_p95_ms": 12.0, "throughput_fps": 25.0, "control_rate_hz": 21.9}
    metrics |= {"size_mb": 66.4, "peak_memory_mb": 500.0, "cpu_pct": None, "throttled": "0x50000"}
    promised = params()["gates"]["original"]
    rows = plots.check_gates(metrics, promised)
    assert [row["gate"] for row in rows] == list(promised)
    assert [row["passed"] for row in rows] == [False, True, True, False, True, False, None, None, None, False]
    table = plots.gates(rows)
    assert table.rows[0][1] == "20 to 40" and table.caption == "3 of 10 promises kept, 4 missed, 3 not shown"
    assert [table.rows[i][-1] for i in (0, 1, 6)] == ["MISSED", "kept", "not shown"]


def test_a_sentence_leaves_no_figure_and_takes_an_old_one_away(tmp_path):
    old = tmp_path / "figures" / "01_faults.png"
    old.parent.mkdir()
    old.touch()
    assert repr(plots.save(Note("no faults"), tmp_path, "01_faults")) == "no faults" and not old.exists()
