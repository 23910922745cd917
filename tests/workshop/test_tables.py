"""README's tables: what results/ says, and nothing else."""

import json
import shutil

import pytest

from rover_lib.workshop import tables

RESULTS = tables.README.parent / "results"


def test_readme_says_what_results_say():
    """Fails where a number in README was typed, or results/ was published without `make tables`."""
    text = tables.README.read_text()
    assert tables.written(text, RESULTS) == text


def test_a_number_that_was_typed_is_written_over(tmp_path):
    readme = tmp_path / "README.md"
    right = tables.README.read_text()
    readme.write_text(right.replace("| artifact, MB | ", "| artifact, MB | 1", 1))
    assert tables.update(readme, RESULTS) and readme.read_text() == right
    assert not tables.update(readme, RESULTS)


def test_a_figure_changes_with_its_json(tmp_path):
    results = shutil.copytree(RESULTS, tmp_path / "results")
    report = json.loads((results / "lab" / "faults.json").read_text())
    next(f for f in report["metrics"]["faults"] if f["expected"] == "stopped")["wrong"] = ["throttle went on"]
    (results / "lab" / "faults.json").write_text(json.dumps(report))
    old, new = (tables.written(tables.README.read_text(), folder).splitlines() for folder in (RESULTS, results))
    (line,) = [b for a, b in zip(old, new, strict=True) if a != b]
    assert "36 of 37" in line


def test_what_was_not_counted_is_no_row(tmp_path):
    results = shutil.copytree(RESULTS, tmp_path / "results")
    (results / "demo" / "arm.json").unlink(missing_ok=True)
    text = tables.written(tables.README.read_text(), results)
    assert "artifact, MB |" in text and "(`make arm NAME=demo`)" not in text


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text.replace("<!-- table faults", "<!-- table fault"), "each table once, found .*fault"),
        (lambda text: text.replace("<!-- table", "<!--"), "each table once, found none"),
    ],
)
def test_readme_without_a_table_is_left_as_it_is(tmp_path, change, message):
    readme = tmp_path / "README.md"
    text = change(tables.README.read_text())
    readme.write_text(text)
    with pytest.raises(tables.TableError, match=message):
        tables.update(readme, RESULTS)
    assert readme.read_text() == text


def test_results_without_their_json(tmp_path):
    with pytest.raises(tables.TableError, match=r"compare\.json must be there once, found none"):
        tables.written(tables.README.read_text(), tmp_path)
