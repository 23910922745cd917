"""Random drives: what they find. That each invariant can find something, `make mutants` shows."""

import re

import pytest
from click.testing import CliRunner

from lab.__main__ import main
from lab.driving.invariants import broken
from lab.driving.stories import KEPT, drive_story, random_story
from rover_lib.onboard.stage import read_stage
from tests.helpers import needs

pytestmark = needs.gcc


@pytest.mark.slow
def test_200_random_drives_break_nothing(tmp_path):
    done = CliRunner().invoke(main, ["random", str(tmp_path / "random.json"), "--drives", "200", "--jobs", "1"])
    assert done.exit_code == 0, done.output
    found = read_stage(tmp_path / "random.json", "random")["metrics"]
    assert found["driven"] > 70


@pytest.mark.parametrize("name", KEPT)
def test_what_once_broke_one(name):
    story, end = KEPT[name]
    seen = drive_story(story)
    assert list(broken(seen)) == []
    assert re.search(end, seen.drives[-1][2])


def test_the_same_seed_is_the_same_drive():
    first, second = (drive_story(random_story(4)) for _ in range(2))
    assert first.log == second.log and first.commands == second.commands
