"""The pages' tables: what results/ and the notebooks say, and nothing else."""

from lab.repository import page_tables as tables


def test_pages_say_what_results_and_notebooks_say():
    """Fails where a number in a page was typed, or results/ or a notebook changed without a new table."""
    assert tables.changed_pages() == {}
