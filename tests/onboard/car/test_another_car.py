"""A car other than the first: its recordings, its artifacts, its reverse, and its policy on a different car."""

from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from rover_lib.onboard.artifact.manifest import car_of
from rover_lib.onboard.car.car import Car, read_car
from rover_lib.onboard.drive.drive import another_car
from rover_lib.onboard.drive.plan import Follower, Plan, Settings
from rover_lib.onboard.drive.session import arm_capped
from rover_lib.onboard.errors import ArtifactError, CarError, EpisodeError
from rover_lib.onboard.policy.load import action_limits
from rover_lib.onboard.recording.episode import car_in, read_car_of
from rover_lib.workshop.recordings.episodes import load_recordings
from rover_lib.workshop.recordings.samples import car_of as recorded_car_of
from tests.helpers.recorded import content_of, edit_json, record_there_and_back

CRAWLER = read_car(Path(__file__).parents[3] / "lab" / "cars" / "crawler.yml")


def test_a_recording_carries_its_car(tmp_path):
    folder = record_there_and_back(tmp_path / "episode_0", CRAWLER)
    assert read_car_of(folder) == CRAWLER
    assert read_car_of(record_there_and_back(tmp_path / "first/episode_0", Car())) == Car()
    assert {row["throttle_raw_us"] for row in content_of(folder)["control_samples"]} == {1550, 1450}
    actions = np.concatenate([s.chunk for s in load_recordings(tmp_path).samples])
    assert (actions[:, 1].min(), actions[:, 1].max(), actions[0, 0]) == pytest.approx((-0.1, 0.1, 0.5))


def test_a_recording_of_no_car_is_left_out_and_said(tmp_path):
    good, bad = (record_there_and_back(tmp_path / name, CRAWLER) for name in ("episode_0", "episode_1"))
    edit_json(bad / "episode_data.json", lambda content: content["metadata"]["car"]["steering"].update(neutral_us=5))
    recordings = load_recordings(tmp_path)
    assert [e.id for e in recordings.episodes] == [good.name]
    assert any(fault.kind == "no_car" for fault in recordings.faults)
    with pytest.raises(CarError, match="between its two ends"):
        read_car_of(bad)


def test_a_mirrored_car_is_another_one(tmp_path):
    """Same pulses, and +1 turns it to the other side: the first car's policy would steer it mirrored."""
    ours, mirrored = Car(), Car(name="hers", positive="left")
    assert read_car_of(record_there_and_back(tmp_path / "hers/episode_0", mirrored)).positive == "left"
    assert car_in({"steering_positive": "left"}, "older").positive == "left" and car_in({}, "oldest") == ours
    assert "turns 'hers' left and \"the recordings' car\" right" in mirrored.unlike(ours)
    record_there_and_back(tmp_path / "ours/episode_1", ours)
    mixed = [sample for root in ("hers", "ours") for sample in load_recordings(tmp_path / root).samples]
    with pytest.raises(EpisodeError, match="of several cars, found steering"):
        recorded_car_of(mixed)
    for manifest, this in (({"car": mirrored.description()}, ours), ({}, mirrored)):
        with pytest.raises(CarError, match=r"would steer mirrored: steering \+1 turns"):
            another_car(manifest, this)
    assert another_car({"car": mirrored.description()}, mirrored) == ""


def test_an_artifact_says_whose_it_is():
    manifest = {"car": CRAWLER.description()}
    assert car_of(manifest) == CRAWLER
    assert car_of({}) == Car()
    with pytest.raises(ArtifactError, match="steering must be a mapping, found nothing"):
        car_of({"car": {"throttle": {}}})
    assert "calibrated for 'crawler', and this car is" in another_car(manifest, Car(positive="left"))
    assert another_car(manifest, CRAWLER) == another_car({}, Car()) == ""
    assert action_limits(["throttle", "wrist"], CRAWLER).tolist() == [[-1, -np.inf], [1, np.inf]]


def test_plans_with_reverse():
    for car, asked, throttle in ((CRAWLER, -0.6, -0.3), (Car(), -0.2, 0.0)):  # the limit holds in both directions
        follower = Follower(Settings(blend_ticks=0, throttle_limit=0.3), 30.0)
        follower.add(Plan(1, 0.0, 0.0, np.tile([0.2, asked], (8, 1)), car.limits), 0.0)
        assert follower.command(0.0).throttle == throttle


@pytest.mark.parametrize(
    ("car", "limit", "asked_us", "gets_us", "told"),
    [
        (Car(), 0.1, (179,), 179, None),
        (Car(), 0.2, (238,), 200, "at most throttle 0.14 (200 us)"),
        (CRAWLER, 0.2, (1400, 1600), 1550, "at most throttle 0.10 (1550 us)"),  # the farther of the two directions
    ],
)
def test_the_arduino_is_told_what_a_drive_may_use(car, limit, asked_us, gets_us, told):
    """And the human, where it gives less than that: it was cut in silence."""
    said, link = [], Mock(calibration=car.pwm)
    link.lower_cap.return_value = Mock(cap_us=gets_us)
    assert arm_capped(link, limit, said.append) is link.arm.return_value
    assert link.lower_cap.call_args[0][0] in asked_us
    assert [told in text for text in said] == [True] * (told is not None)
