"""Fixtures that several folders of tests share."""

from pathlib import Path

import pytest

REPO = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def sample_episode():
    """A real recording (its folder), where there is one in shared/ in or beside the checkout; nothing needs
    it.
    """
    for base in (REPO, REPO.parent):
        found = sorted((base / "shared" / "sample_episode").glob("episode_*/episode_data.json"))
        if found:
            return found[0].parent
    pytest.skip("no real recording here: put one at shared/sample_episode/episode_*/ to run this test on it")
