"""The pages' tables: what results/ and the notebooks say, and nothing else."""

import shutil

import pytest

from lab.repository import page_tables as tables
from rover_lib.onboard.errors import RoverError


def test_pages_say_what_results_and_notebooks_say():
    """Fails where a number in a page was typed, or results/ or a notebook changed without a new table."""
    assert tables.changed_pages() == {}


def test_a_number_that_was_typed_is_written_over_and_a_missing_table_is_told(tmp_path):
    for name in ("results", "docs", "notebooks"):
        shutil.copytree(tables.ROOT / name, tmp_path / name)
    right, readme = (tables.ROOT / "README.md").read_text(), tmp_path / "README.md"
    readme.write_text(right.replace("| FP32, as trained | ", "| FP32, as trained | 1", 1))
    assert tables.changed_pages(tmp_path) == {readme: right}
    readme.write_text(right.replace("<!-- table demo", "<!-- table dem"))
    with pytest.raises(RoverError, match="each table once"):
        tables.changed_pages(tmp_path)
