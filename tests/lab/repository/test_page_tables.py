"""The pages' tables: what results/ and the notebooks say, and nothing else."""

import json
import shutil

import pytest

from lab.repository import page_tables as tables
from rover_lib.workshop.run.run import AFTERWARDS, NAMES, NOTEBOOKS, parameters_of


@pytest.fixture
def checkout(tmp_path):
    """What tables are made of, and where they stand."""
    for name in ("results", "docs", "notebooks"):
        shutil.copytree(tables.ROOT / name, tmp_path / name)
    shutil.copy(tables.ROOT / "README.md", tmp_path)
    return tmp_path


def lines_of(root):
    return [line for text in tables.render_pages(tables.pages(root), root).values() for line in text.splitlines()]


def test_pages_say_what_results_and_notebooks_say():
    """Fails where a number in a page was typed, results/ was published or a notebook changed without `make tables`."""
    texts = tables.pages()
    assert tables.render_pages(texts, tables.ROOT) == texts


def test_a_number_that_was_typed_is_written_over(checkout):
    readme = checkout / "README.md"
    right = readme.read_text()
    readme.write_text(right.replace("| FP32, as trained | ", "| FP32, as trained | 1", 1))
    assert tables.update(checkout) == [readme] and readme.read_text() == right
    assert not tables.update(checkout)


def test_a_figure_changes_with_its_json(checkout):
    before, path = lines_of(checkout), checkout / "results" / "lab" / "faults.json"
    report = json.loads(path.read_text())
    next(f for f in report["metrics"]["faults"] if f["expected"] == "stopped")["wrong"] = ["throttle went on"]
    path.write_text(json.dumps(report))
    (line,) = [b for a, b in zip(before, lines_of(checkout), strict=True) if a != b]
    assert "37 of 38" in line


def test_each_parameter_of_each_notebook_is_in_the_table(checkout):
    """With its comment: what papermill's -p sets is documented where it is set."""
    rows = [line.split(" | ") for line in lines_of(checkout) if "](../notebooks/" in line and line.count(" | ") == 3]
    found = {(cells[0].partition("[")[2].partition("]")[0], cells[1].strip("`")) for cells in rows}
    known = {(name, each) for name in NAMES + AFTERWARDS for each in parameters_of(NOTEBOOKS / f"{name}.ipynb")}
    assert found == known and all(len(cells[3]) > 10 for cells in rows)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text.replace("<!-- table demo", "<!-- table dem"), "each table once, found .*dem'"),
        (lambda text: text + "<!-- table faults, by make tables -->\n<!-- end -->", "each table once, found .*faults"),
    ],
)
def test_pages_without_a_table_are_left_as_they_are(checkout, change, message):
    readme = checkout / "README.md"
    text = change(readme.read_text())
    readme.write_text(text)
    with pytest.raises(tables.TableError, match=message):
        tables.update(checkout)
    assert readme.read_text() == text


def test_results_without_their_json(checkout):
    shutil.rmtree(checkout / "results")
    with pytest.raises(tables.TableError, match=r"compare\.json must be there once, found none"):
        tables.render_pages(tables.pages(checkout), checkout)
