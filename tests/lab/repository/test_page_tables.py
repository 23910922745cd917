"""The pages' tables: what results/ and the notebooks say, and nothing else."""

import re
import shutil

import pytest

from lab.repository import page_tables as tables
from rover_lib.onboard.errors import RoverError
from rover_lib.workshop.run.run import AFTERWARDS, NAMES, NOTEBOOKS, parameters_in, parameters_of


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
    """Fails where a number in a page was typed, or results/ or a notebook changed without a new table."""
    texts = tables.pages()
    assert tables.render_pages(texts, tables.ROOT) == texts


def test_a_number_that_was_typed_is_written_over(checkout):
    readme = checkout / "README.md"
    right = readme.read_text()
    readme.write_text(right.replace("| FP32, as trained | ", "| FP32, as trained | 1", 1))
    assert tables.update(checkout) == [readme] and readme.read_text() == right
    assert not tables.update(checkout)


def test_each_parameter_of_each_notebook_is_in_the_table(checkout):
    """And has a comment where it is set, which is where papermill and the page say that its meaning stands."""
    rows = [line.split("|")[1:4] for line in lines_of(checkout) if line.startswith("| [0")]
    found = {re.search(r"\[(\w+)\]", name)[1]: {*re.findall(r"`(\w+)`", names)} for name, _, names in rows}
    assert found == {n: set(parameters_of(NOTEBOOKS / f"{n}.ipynb")) - {"run_dir"} for n in NAMES + AFTERWARDS}
    assert all(len(why) > 10 for n in found for *_, why in parameters_in(NOTEBOOKS / f"{n}.ipynb"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text.replace("<!-- table demo", "<!-- table dem"), "each table once, found .*dem'"),
        (lambda text: text + "<!-- table faults, by page_tables -->\n<!-- end -->", "each table once, found .*faults"),
    ],
)
def test_pages_without_a_table_are_left_as_they_are(checkout, change, message):
    readme = checkout / "README.md"
    text = change(readme.read_text())
    readme.write_text(text)
    with pytest.raises(RoverError, match=message):
        tables.update(checkout)
    assert readme.read_text() == text


def test_results_without_their_json(checkout):
    shutil.rmtree(checkout / "results")
    with pytest.raises(RoverError, match=r"compare\.json must be there once, found none"):
        tables.render_pages(tables.pages(checkout), checkout)
