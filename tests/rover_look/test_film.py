"""A past drive is shown from its pictures and its flight log, as moments, as a film, and in the view."""

import asyncio
import csv
import json
from datetime import datetime

import av
import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

from rover_lib.cli import main
from rover_lib.onboard.car.car import Car
from rover_lib.onboard.car.pwm import PwmCalibration
from rover_lib.onboard.drive.flight_log import FlightLog, LogError, Tick, read_log
from rover_lib.onboard.errors import EpisodeError
from rover_lib.onboard.recording.episode import About, EpisodeWriter
from rover_lib.onboard.view.path_overlay import CarShape
from rover_lib.workshop.progress import silent
from rover_look import film as f
from rover_look import replay as r

SECONDS, HZ, PICTURES_HZ = 2.0, 30, 10


class Pace:
    """The clock of the log's ticks."""

    def __init__(self):
        self.now = 50.0

    def __call__(self):
        return self.now


def drive(folder, *, recorded=True, pictures=True, car=None):
    """Write a flight log and the episode that was recorded with it. Returns the log's path."""
    described = {"car": car.description()} if car else {}
    clock, episode = Pace(), folder / "episodes" / "episode_1"
    with FlightLog(folder / "flight.log", header={"hz": HZ, "artifact": "runs/x/policy_static.pt"} | described,
                   max_bytes=1_000_000, keep=1, clock=clock) as log:  # fmt: skip
        log.event("armed")
        for k in range(round(SECONDS * HZ)):
            clock.now = 50.0 + k / HZ
            log.tick(Tick(k / HZ, 0.25, "A", "a", 0.5 * np.sin(k / 20), 0.05 + k / 2000, 1500, 150 + k, 1500, 149 + k,
                          1 + k // 6, 150.0, 125.0, 1.0, k))  # fmt: skip
        clock.now += 0.05
        if recorded:
            log.event(f"recorded: {episode}")
    if pictures:
        start = datetime.fromisoformat(read_log(folder / "flight.log").header["start"]).timestamp()
        (episode / "frames").mkdir(parents=True)
        with (episode / "frame_data.csv").open("w", newline="") as file:
            rows = csv.writer(file)
            rows.writerow(["frame_id", "timestamp", "image_path"])
            for k in range(round(SECONDS * PICTURES_HZ)):
                name = f"frames/frame_{k:06d}.jpg"
                cv2.imwrite(str(episode / name), np.full((90, 160, 3), 30 + 5 * k, np.uint8))
                rows.writerow([k, start + k / PICTURES_HZ + 0.01, name])
            rows.writerow([99, start + 0.5, "../../../secret.jpg"])
    return folder / "flight.log"


def test_each_picture_has_what_the_log_says_of_its_moment(tmp_path):
    found = r.load_replay(drive(tmp_path)).moments
    ticks = read_log(tmp_path / "flight.log").ticks
    assert [round(m.t_s, 2) for m in found] == [round(k / PICTURES_HZ, 2) for k in range(20)]  # and none from outside
    for k, moment in enumerate(found):
        row = 3 * k  # the last tick before the picture
        tick = moment.head["tick"]
        for name in ("t_s", "throttle", "steering", "throttle_us", "pins_throttle_us", "plan", "latency_ms"):
            assert tick[name] == pytest.approx(ticks[name][row]), name
        ahead = np.stack([ticks["steering"], ticks["throttle"]], axis=1)[row : row + HZ]
        assert np.allclose(moment.head["plan"]["actions"], ahead)
        assert (moment.head["who"], moment.head["why"], moment.head["missed"]) == ("A", "armed by the host", 0)
        assert moment.head["title"] == "policy_static.pt" and moment.head["text"] == r.AHEAD
        assert abs(int(moment.frame_bgr().mean()) - (30 + 5 * k)) <= 2
        json.dumps(moment.head)
    assert found[5].head["events"][0][1] == "armed" and len(found[5].head["events"]) == 1


def test_the_ribbon_and_the_bars_are_of_the_moment():
    frame = np.full((360, 640, 3), 90, np.uint8)
    plan = {"captured_s": 0.0, "rate_hz": 30.0, "actions": [[0.0, 0.09]] * 30}
    head = {"tick": {"steering": -0.5, "throttle": 0.1, "plan_age_ms": 150, "latency_ms": 90, "late_ms": 0.4},
            "pins": [1456, 120], "who": "A", "missed": 0,
            "events": [[1.0, "armed"]], "sent_s": 0.0, "plan": plan}  # fmt: skip
    shape, pwm = CarShape.of(), PwmCalibration()
    picture = f.draw_moment(head, frame, shape, pwm)
    assert picture.shape == (360 + f.PANEL, 640, 3)
    way = np.argwhere(picture[:360, :, 1].astype(int) > picture[:360, :, 0] + 15)
    assert way[:, 0].min() > 125 and abs(way[:, 1].mean() - 320) < 2  # below the horizon, straight ahead
    to_the_left = f.draw_moment(head | {"plan": plan | {"actions": [[-0.6, 0.09]] * 30}}, frame, shape, pwm)
    way = np.argwhere(to_the_left[:360, :, 1].astype(int) > to_the_left[:360, :, 0] + 15)
    assert way[:, 1].mean() < 310
    assert (f.draw_moment(head | {"plan": plan | {"actions": [[0.6, 0.0]] * 30}}, frame, shape, pwm)[:360] == 90).all()
    bar = picture[360 + 19, 84:265]  # steering fills half of the bar's left half, and the pin's line is in the middle
    filled = np.flatnonzero((bar == f.FILL).all(axis=1))
    assert (84 + filled.min(), 84 + filled.max()) == pytest.approx((129, 172), abs=3)
    assert np.flatnonzero((bar == f.PIN).all(axis=1)).mean() == pytest.approx(90, abs=1)


OTHER = Car.of(
    {
        "name": "another car",
        "steering": {"period_us": 20000, "left_us": 2000, "neutral_us": 1500, "right_us": 1000},
        "throttle": {"period_us": 20000, "neutral_us": 1500, "forward_us": 2000},
        "camera": {"field_of_view_deg": 120},
        "wheelbase_m": 0.5,
    }
)


def test_a_film_is_of_the_car_that_was_driven(tmp_path):
    replay = r.load_replay(drive(tmp_path, car=OTHER))
    assert replay.car == OTHER
    moment = replay.moments[10]
    picture = f.draw_moment(moment.head, moment.frame_bgr(), CarShape.of(OTHER), OTHER.pwm)
    with_this_machines = f.draw_moment(moment.head, moment.frame_bgr(), CarShape.of(), PwmCalibration())
    filmed = list(f._pictures(replay, PICTURES_HZ, f.WIDTH, silent))[10]
    assert (filmed == picture).all() and (filmed != with_this_machines).any()
    # Its steering pin stood at 1500 us, which is neutral for that car: the line is in the middle of the bar.
    bar = filmed[-f.PANEL + 12, 84:265]
    assert np.flatnonzero((bar == f.PIN).all(axis=1)).mean() == pytest.approx(90, abs=1)


def test_a_replayed_recording_has_its_own_cars_pulses(tmp_path):
    with EpisodeWriter(tmp_path / "episode_20260101_000000", About("a test", car=OTHER), resolution=(64, 36)) as writer:
        for n in range(60):
            pulses = OTHER.pwm.pulses(0.5, 0.1)
            writer.control(n / 30, n * 33, pulses.steering_us, pulses.throttle_us, 20000, 20000)
            writer.frame(n / 30, np.full((36, 64, 3), n, np.uint8))
    replay = r.load_replay(tmp_path)
    assert replay.car == OTHER and replay.moments[3].head["pins"] == [1750, 1550]


@pytest.mark.slow
def test_a_film_has_the_drives_pace_and_pictures(tmp_path):
    log = drive(tmp_path)
    arguments = ["log", str(log), "--video", str(tmp_path / "out.mp4"), "--video-hz", "20", "--video-width", "321"]
    done = CliRunner().invoke(main, arguments)
    assert done.exit_code == 0, done.output
    assert "out.mp4, 39 pictures" in done.output and not (tmp_path / "flight.log.png").exists()
    with av.open(str(tmp_path / "out.mp4")) as container:
        images = [image.to_ndarray(format="rgb24") for image in container.decode(video=0)]
    assert len(images) == 39 and images[0].shape == (240, 320, 3)
    means = [image[5:60].mean() for image in images]  # above the horizon: each picture is lighter than the one before
    assert abs(means[0] - 30) < 4 and 115 < means[-1] < 129 and np.all(np.diff(means) > -1)
    done = CliRunner().invoke(main, ["log", str(log), "--video", str(tmp_path / "out.webp"), "--video-hz", "5"])
    assert done.exit_code == 0, done.output
    with Image.open(tmp_path / "out.webp") as film:
        assert film.n_frames == 10 and film.size == (640, 360 + f.PANEL)


@pytest.mark.parametrize(
    ("made", "output", "sentence"),
    [
        ({}, "out.avi", "a film ends in .mp4 or .webp"),
        ({"recorded": False}, "out.mp4", "no pictures were recorded with this drive; `rover drive --record FOLDER`"),
        ({"pictures": False}, "out.mp4", "the drive's pictures are not there; name them by --pictures"),
    ],
)
def test_what_makes_no_film_leaves_nothing(tmp_path, made, output, sentence):
    log = drive(tmp_path, **made)
    done = CliRunner().invoke(main, ["log", str(log), "--video", str(tmp_path / output)])
    assert done.exit_code == 1 and sentence in done.output, done.output
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(("out", ".out"))]


def test_pictures_of_another_drive_are_refused(tmp_path):
    log = drive(tmp_path)
    rows = (tmp_path / "episodes/episode_1/frame_data.csv").read_text().splitlines()
    late = [f"{i},{float(row.split(',')[1]) + 1000},{row.split(',')[2]}" for i, row in enumerate(rows[1:])]
    (tmp_path / "episodes/episode_1/frame_data.csv").write_text("\n".join([rows[0], *late]))
    with pytest.raises(EpisodeError, match="none of its pictures is of the drive"):
        r.load_replay(log)
    with pytest.raises(LogError, match="no drive 3"):
        r.load_replay(log, drive=3)


def test_a_damaged_time_in_the_list_costs_its_picture_alone(tmp_path):
    log = drive(tmp_path)
    whole = r.load_replay(log).moments
    listed = tmp_path / "episodes/episode_1/frame_data.csv"
    sound = listed.read_text()
    listed.write_text(f"{sound}100,nan,frames/frame_000003.jpg\n101,inf,frames/frame_000003.jpg\n")
    assert r.load_replay(log).moments == whole
    listed.write_text(f"{sound}100,1,frames/frame\0.jpg\n")
    with pytest.raises(EpisodeError, match="its list of pictures cannot be read"):
        r.load_replay(log)


def test_a_view_shows_it_again_and_again_in_its_own_time(tmp_path, monkeypatch):
    shown, slept = [], []

    class View:
        def show(self, head, picture):
            shown.append((head, picture))
            if len(shown) > 30:
                raise asyncio.CancelledError

    async def sleep(seconds):
        slept.append(seconds)

    monkeypatch.setattr(r.asyncio, "sleep", sleep)
    with pytest.raises(asyncio.CancelledError):
        asyncio.run(r.load_replay(drive(tmp_path)).show(View()))
    assert [h["tick"]["t_s"] for h, _ in shown[:20]] == sorted(h["tick"]["t_s"] for h, _ in shown[:20])
    assert shown[20][0]["tick"] == shown[0][0]["tick"] and r.AGAIN_S in slept
    assert {h["phase"] for h, _ in shown} == {"replay"} and all(p[:2] == b"\xff\xd8" for _, p in shown)
