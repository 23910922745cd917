"""A past drive as a figure and as a film, from its flight log and the pictures recorded with it."""

import json
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

import rover_lib.cli  # noqa: F401  # first, as commands import it
from rover_exchange import cli, film
from rover_exchange.flight import flight_figure
from rover_exchange.moments import began_s, moments_of
from rover_lib.onboard.car.car import Car, read_car
from rover_lib.onboard.car.pwm import PwmCalibration
from rover_lib.onboard.drive.flight_log import FlightLog, Tick, read_log
from rover_lib.onboard.errors import EpisodeError, RoverError
from tests.helpers.command import rover

ROOT = Path(__file__).parents[2]
SECONDS, HZ, PICTURES_HZ = 2.0, 30, 10


def drive(folder, *, recorded=True, pictures=True, seconds=SECONDS):
    """Write a flight log and the episode that was recorded with it. Returns the log's path."""
    header = {"hz": HZ, "fade_s": 0.5, "stop_s": 1.0}
    path, now_s, episode = folder / "flight.log", [50.0], folder / "episodes" / "episode_1"
    with FlightLog(path, header=header, max_bytes=1_000_000, keep=1, clock=lambda: now_s[0]) as log:
        log.event("it began")
        for k in range(round(seconds * HZ)):
            now_s[0] = 50.0 + k / HZ
            log.tick(Tick(k / HZ, 0.25, "A" if k < 50 else "M", "a", 0.5 * np.sin(k / 20), 0.05 + k / 2000, 1500,
                          150 + k, 1500, 149 + k, 1 + k // 6, 150.0, 125.0, 1.0 - 0.1 * (k > 20), k, 0.5))  # fmt: skip
        now_s[0] += 0.05
        if recorded:
            log.event(f"recorded: {episode}")
    if pictures:
        start = began_s(read_log(path))
        (episode / "frames").mkdir(parents=True)
        lines = ["frame_id,timestamp,image_path"]
        for k in range(round(SECONDS * PICTURES_HZ)):
            name = f"frames/frame_{k:06d}.jpg"
            cv2.imwrite(str(episode / name), np.full((90, 160, 3), 30 + 5 * k, np.uint8))
            lines.append(f"{k},{start + k / PICTURES_HZ + 0.01},{name}")
        lines += [f"99,{start + 0.5},../../../secret.jpg", "100,nan,frames/frame_000003.jpg"]
        (episode / "frame_data.csv").write_text("\n".join(lines))
    return path


def test_each_picture_has_what_the_log_says_of_its_moment(tmp_path):
    flight = read_log(drive(tmp_path))
    found = moments_of(flight)
    assert [round(m.t_s, 2) for m in found] == [round(k / PICTURES_HZ + 0.01, 2) for k in range(20)]
    for k, moment in enumerate(found):
        row = 3 * k  # the last tick before the picture
        for name in ("t_s", "throttle", "steering", "throttle_us", "pins_throttle_us", "plan", "latency_ms"):
            assert moment.tick[name] == pytest.approx(flight.ticks[name][row]), name
        ahead = np.stack([flight.ticks["steering"], flight.ticks["throttle"]], axis=1)[row : row + HZ]
        assert np.allclose(moment.ahead, ahead)
    assert found[-1].tick["state"] == "M" and found[5].event.endswith("it began")


def test_pictures_of_another_drive_or_a_damaged_list_are_refused(tmp_path):
    flight = read_log(drive(tmp_path))
    listed = tmp_path / "episodes/episode_1/frame_data.csv"
    for text, says in (("1,1000,frames/frame_000001.jpg", "none of its pictures"), ("1,1,frame\0.jpg", "be read")):
        listed.write_text(f"frame_id,timestamp,image_path\n{text}\n")
        with pytest.raises(EpisodeError, match=says):
            moments_of(flight)
    (tmp_path / "episodes").rename(tmp_path / "gone")
    with pytest.raises(EpisodeError, match="not there"):
        moments_of(flight)
    flight.header.clear()
    with pytest.raises(RoverError, match="damaged"):
        moments_of(flight)


def test_the_path_and_the_bars_are_of_the_moment_and_of_its_car(tmp_path):
    moment, frame = moments_of(read_log(drive(tmp_path)))[10], np.full((90, 160, 3), 90, np.uint8)
    moment.tick["steering"] = -0.5

    def drawn(action, car):
        moment.ahead[:] = action
        return film.draw_moment(moment, frame, car, 1 / HZ)

    def columns_of_path(picture):
        return np.argwhere(picture[:360, :, 1].astype(int) > picture[:360, :, 0] + 15)[:, 1]

    crawler = read_car(ROOT / "lab/cars/crawler.yml")
    for car in (Car(), crawler):
        ahead = drawn([0.0, 0.09], car)
        assert ahead.shape == (360 + film.PANEL, 640, 3) and abs(columns_of_path(ahead).mean() - 320) < 2
        assert (columns_of_path(drawn([0.6, 0.09], car)).mean() - 320) * car.left < 0
        assert not len(columns_of_path(drawn([0.6, 0.0], car)))
        bar = ahead[360 + 12, 84:265]  # steering fills half of a half of the bar
        assert np.count_nonzero((bar == film.FILL).all(axis=1)) == pytest.approx(45, abs=4)


@pytest.mark.slow
def test_a_film_has_the_drives_pace_and_pictures(tmp_path):
    log = drive(tmp_path)
    done = rover("log", log, "--video", tmp_path / "out.mp4")
    assert done.exit_code == 0 and not (tmp_path / "flight.log.png").exists(), done.output
    with av.open(str(tmp_path / "out.mp4")) as container:
        images = [image.to_ndarray(format="rgb24") for image in container.decode(video=0)]
    assert len(images) == 58 and images[0].shape == (360 + film.PANEL, 640, 3)
    means = [image[5:60].mean() for image in images]  # above the horizon: each picture is lighter than the one before
    assert abs(means[0] - 30) < 4 and 115 < means[-1] < 129 and np.all(np.diff(means) > -1)


@pytest.mark.parametrize(
    ("made", "output", "word"), [({}, "out.avi", "ends in .mp4"), ({"recorded": False}, "out.mp4", "--record")]
)
def test_what_makes_no_film_leaves_nothing(tmp_path, made, output, word):
    done = rover("log", drive(tmp_path, **made), "--video", tmp_path / output)
    assert done.exit_code == 1 and word in done.output, done.output
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(("out", ".out"))]


def lines_of(ax):
    return {line.get_label(): line for line in ax.get_lines() if not line.get_label().startswith("_")}


def test_what_is_drawn(tmp_path):
    flight = read_log(drive(tmp_path, pictures=False))
    figure = flight_figure(flight)
    _, steering, throttle, plan, late, unfamiliar = figure.axes
    assert lines_of(steering)["commanded, us"].get_ydata().tolist() == flight.ticks["steering_us"].tolist()
    assert lines_of(throttle)["the Arduino's pin"].get_ydata().tolist() == flight.ticks["pins_throttle_us"].tolist()
    assert len(lines_of(plan)["latency of each"].get_xdata()) == 10  # one per plan, not per tick
    assert lines_of(plan)["stopped from 1000 ms on"].get_ydata()[0] == 1000
    assert lines_of(late)["lateness of a command"].get_ydata().tolist() == flight.ticks["late_ms"].tolist()
    assert unfamiliar.get_lines()[0].get_ydata().tolist() == flight.ticks["strange"].tolist()
    empty = flight_figure(read_log(drive(tmp_path, pictures=False, recorded=False, seconds=0.0)))
    for drawn in (figure, empty):
        drawn.draw_without_rendering()
    top = PwmCalibration().steering.action(steering.get_ylim()[1])
    assert steering.child_axes[0].get_ylim()[1] == pytest.approx(top, abs=1e-3)


@pytest.mark.slow
def test_the_command_draws(tmp_path):
    path, other = drive(tmp_path, pictures=False), tmp_path / "other.pdf"
    result = rover("log", path)
    assert result.exit_code == 0 and path.with_name("flight.log.png").read_bytes().startswith(b"\x89PNG"), result.output
    assert json.loads(rover("log", path, "--json", "-o", other).stdout)["ticks"] == 60
    assert other.read_bytes().startswith(b"%PDF")
    refused = rover("log", path, "-o", tmp_path / "other.txt")
    assert refused.exit_code == 1 and ".png" in refused.output


@pytest.mark.parametrize("screen", ["", "DISPLAY", "WAYLAND_DISPLAY"])
def test_a_browser_is_opened_where_there_is_a_screen(monkeypatch, screen):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.setenv(name, ":0" if name == screen else "")
    opened = []
    monkeypatch.setattr(cli.webbrowser, "open", opened.append)
    cli.open_browser("http://127.0.0.1:1")
    assert opened == (["http://127.0.0.1:1"] if screen else [])
