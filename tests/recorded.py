"""Where a real recording lies, for the tests that want to see one."""

from pathlib import Path

import pytest

REPO = Path(__file__).resolve().parents[1]


def real_episode() -> Path:
    """Folder of a real recording in shared/, in or beside the checkout. Skips the test where there is none."""
    for base in (REPO, REPO.parent):
        found = sorted((base / "shared" / "sample_episode").glob("episode_*/episode_data.json"))
        if found:
            return found[0].parent
    pytest.skip("no real recording here: put one at shared/sample_episode/episode_*/ to run this test on it")
