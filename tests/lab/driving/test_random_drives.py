"""Random drives: what they find, that each invariant can find something, and that a failure becomes short."""

import re
import shutil

import needs
import pytest
from click.testing import CliRunner

from lab.__main__ import main
from lab.driving import virtual
from lab.driving.invariants import broken
from lab.driving.random_drives import random_drives
from lab.driving.stories import HAPPENINGS, KEPT, Happening, Story, drive_story, random_story, shortest
from rover_lib.onboard.drive import pilot

pytestmark = needs.gcc


@pytest.mark.slow
def test_200_random_drives_break_nothing():
    found = random_drives(range(200))
    assert not found["broken"], "\n".join(found["broken"])
    assert found["driven"] > 70 and found["firmware_states"] > 50


@pytest.mark.parametrize("name", KEPT)
def test_what_once_broke_one(name):
    story, end = KEPT[name]
    seen = drive_story(story)
    assert list(broken(seen)) == []
    assert re.search(end, seen.drives[-1][2])


def test_a_drive_without_faults_drives_until_it_is_told_to_stop():
    seen = drive_story(Story())
    assert [words for _, _, words in seen.drives] == ["told to stop"]
    assert max(event.throttle_us for _, event in seen.pins) == 209


def test_the_same_seed_is_the_same_drive():
    first, second = (drive_story(random_story(4)) for _ in range(2))
    assert first.log == second.log
    assert [(ms, e and bytes(e)) for ms, e in first.pins] == [(ms, e and bytes(e)) for ms, e in second.pins]


# ---- invariants can find something

STEERED = Story((Happening(2300, "the human steers", 300, 2000),))


@pytest.mark.parametrize(
    ("invariant", "good", "bad", "story"),
    [
        ("asked_for", "vehicle->throttle_free ? ", "true ? ", "presets after a loss"),
        ("capped", ")command->throttle_us, vehicle->cap_us);", ")2000, 2000);", "a host that asks for full throttle"),
        ("human_wins", "FAST_MOVED_PULSES : 1)", "8 : 1)", "every third pulse misread"),
        ("human_keeps", "if (vehicle->state == MANUAL && has_signal(vehicle)) {", "if (false) {", STEERED),
        ("armed_by_people", ".seen && let_go ? NOTHING", ".seen | let_go ? NOTHING", "held since before the start"),
    ],
)
@pytest.mark.slow
def test_a_planted_fault_of_the_firmware_is_found(tmp_path, monkeypatch, invariant, good, bad, story):
    """Of the firmware, `make mutants` plants more."""
    shutil.copytree(virtual.FIRMWARE, tmp_path / "firmware")
    source = tmp_path / "firmware" / "rover" / "vehicle.c"
    text = source.read_text()
    assert text.count(good) == 1
    source.write_text(text.replace(good, bad))
    virtual.compile_sketch(tmp_path / "firmware", tmp_path)
    monkeypatch.setattr(virtual, "library", lambda human: tmp_path / virtual.LIBRARY)
    found = list(broken(drive_story(KEPT[story][0] if isinstance(story, str) else story)))
    assert any(sentence.startswith(f"{invariant}: ") for sentence in found), found


@pytest.mark.parametrize(
    ("invariant", "name", "stubbed", "story"),
    [
        ("not_blind", "frozen", lambda *_: None, "frozen since before the start"),
        ("told", "CameraError", ValueError, "pictures of 2.5 s ago, from now on"),
    ],
)
def test_a_planted_fault_of_the_host_is_found(monkeypatch, invariant, name, stubbed, story):
    monkeypatch.setattr(pilot, name, stubbed)
    found = list(broken(drive_story(KEPT[story][0])))
    assert any(sentence.startswith(f"{invariant}: ") for sentence in found), found


# ---- a failure becomes short


def test_a_failure_becomes_short():
    reset = "the Arduino is reset"
    stories = (random_story(seed) for seed in range(1000))
    story = next(s for s in stories if len(s.happenings) > 5 and any(h.what == reset for h in s.happenings))
    short = shortest(story, lambda other: any(h.what == reset for h in other.happenings))
    assert short == Story((Happening(short.happenings[0].at_ms, reset),))


def test_every_happening_is_in_some_story():
    assert {h.what for seed in range(200) for h in random_story(seed).happenings} == set(HAPPENINGS)


@pytest.mark.slow
def test_the_command(tmp_path):
    done = CliRunner().invoke(main, ["random", str(tmp_path / "random.json"), "--drives", "3", "--jobs", "1"])
    assert done.exit_code == 0, done.output
    assert "firmware_states" in (tmp_path / "random.json").read_text()
