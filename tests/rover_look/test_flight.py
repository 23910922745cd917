"""A flight log becomes a figure, and a command draws it."""

import json
import re

import numpy as np
import pytest
from click.testing import CliRunner

from rover_lib.cli import main
from rover_lib.onboard.car.host import Host
from rover_lib.onboard.car.pwm import PwmCalibration
from rover_lib.onboard.drive.flight_log import FlightLog, Tick, read_log
from rover_look.flight import flight_figure


class Pi(Host):
    """A Pi that is warm and has too thin a cable."""

    def temperature_c(self):
        return 61.5

    def throttled(self):
        return "0x50005"


def fly(path, *, seconds=4.0, events=3, header=None, machine=None, hz=30):
    """Write and read the log of a made-up drive: the host drives, its plans grow old, then the human takes over."""
    with FlightLog(path, header={"hz": hz, "fade_s": 0.5, "stop_s": 1.0} if header is None else header,
                   max_bytes=1_000_000, keep=1, host=machine) as log:  # fmt: skip
        for k in range(events):
            log.event(f"event {k} for $5 and $6", frame=k)
        for k in range(int(seconds * hz)):
            t_s = k / hz
            age_s = 0.15 + t_s % 1
            fade = float(np.clip((1 - age_s) / 0.5, 0, 1))
            pulses = PwmCalibration().pulses(0.4 * np.sin(t_s), 0.08 * fade)
            log.tick(
                Tick(t_s, 0.2, "A" if t_s < 3 else "M", "a", 0.4 * np.sin(t_s), 0.08 * fade, pulses.steering_us,
                     pulses.throttle_us, pulses.steering_us, pulses.throttle_us - 2, 1 + int(t_s), age_s * 1000, 150.0,
                     fade, k)
            )  # fmt: skip
    return read_log(path)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "flight.log"


def lines_of(ax):
    return {line.get_label(): line for line in ax.get_lines() if not line.get_label().startswith("_")}


def test_what_is_drawn(path, tmp_path):
    vcgencmd = tmp_path / "vcgencmd"
    vcgencmd.write_text("")
    vcgencmd.chmod(0o755)
    flight = fly(path, machine=Pi(vcgencmd=str(vcgencmd)))
    figure = flight_figure(flight)
    who, steering, throttle, plan, late, temperature = figure.axes
    n = len(flight.ticks["t_s"])
    assert lines_of(steering)["commanded"].get_ydata().tolist() == flight.ticks["steering_us"].tolist()
    assert lines_of(throttle)["the Arduino's pin"].get_ydata().tolist() == flight.ticks["pins_throttle_us"].tolist()
    assert "neutral, 120 us" in lines_of(throttle)
    assert [c.get_label() for c in throttle.collections] == ["faded for the plan's age"]
    assert len(lines_of(plan)["age of the plan"].get_xdata()) == n
    assert len(lines_of(plan)["latency of each"].get_xdata()) == 4  # one per plan, not per tick
    assert lines_of(plan)["fades from 500 ms on"].get_ydata()[0] == 500
    assert lines_of(plan)["stopped from 1000 ms on"].get_ydata()[0] == 1000
    assert "lateness of a command: p50 0.20, p99 0.20, max 0.20 ms; 0 ticks missed" in lines_of(late)
    assert "processor, 61.5 °C at most" in lines_of(temperature)
    assert [c.get_label() for c in temperature.collections] == ["under-voltage, throttled"]
    assert [t.get_text() for t in who.get_legend().get_texts()] == ["human", "host"]
    assert [t.get_text() for t in who.texts] == ["1-3"]
    right = steering.child_axes[0]
    assert right.get_ylabel() == "action"
    figure.draw_without_rendering()
    assert right.get_ylim()[1] == pytest.approx(PwmCalibration().actions_from_pulses(
        steering.get_ylim()[1], 120).steering, abs=1e-3)  # fmt: skip
    assert all(ax.get_ylabel() for ax in figure.axes)
    assert re.search(r"event 1 for \\\$5 and \\\$6; frame 1", figure._supxlabel.get_text())


def test_nothing_is_cut_off(path):
    """All text lies inside the figure, and no panel becomes narrow because of it."""
    figure = flight_figure(fly(path, events=40))
    figure.draw_without_rendering()
    width, height = figure.bbox.size
    texts = [figure._suptitle, figure._supxlabel]
    for ax in figure.axes:
        texts += [ax.yaxis.label, *ax.texts, *(ax.get_legend().get_texts() if ax.get_legend() else ())]
        assert ax.get_window_extent().width > 0.7 * width
    assert len(texts) > 15
    for text in texts:
        box = text.get_window_extent()
        assert box.x0 >= 0 and box.y0 >= 0 and box.x1 <= width and box.y1 <= height, text.get_text()[:50]
    listed = figure._supxlabel.get_text()
    assert "26 earlier events" in listed and "event 39" in listed and "event 25 " not in listed
    assert [t.get_text() for t in figure.axes[0].texts] == ["27-40"]


def test_getting_ready_is_listed_but_not_drawn(path):
    with FlightLog(path, header={"hz": 30}, max_bytes=1_000_000, keep=1) as log:
        log.event("the policy is loaded")
        for k in range(60):
            log.tick(Tick(100 + k / 30, 0.2, "A", "a", 0, 0, 1456, 120, 1456, 120, 0, None, None, 1, k))
    figure = flight_figure(read_log(path))
    assert figure.axes[0].get_xlim() == pytest.approx((100 - 0.02 * 59 / 30, 100 + 59 / 30), abs=1e-3)
    assert not figure.axes[0].texts
    assert "the policy is loaded" in figure._supxlabel.get_text()


@pytest.mark.parametrize("seconds", [0.0, 0.03, 0.5])
def test_a_short_or_poor_log_is_drawn_too(path, seconds):
    figure = flight_figure(fly(path, seconds=seconds, events=0, header={}))
    figure.draw_without_rendering()
    assert len(figure.axes) == 6


def rover(*args):
    return CliRunner().invoke(main, [str(a) for a in args])


@pytest.mark.slow
def test_the_command(path):
    fly(path)
    fly(path, seconds=1.0)
    result = rover("log", path)
    assert result.exit_code == 0, result.output
    figure = path.with_name("flight.log.png")
    assert figure.read_bytes().startswith(b"\x89PNG")
    assert f"drawn: {figure}" in result.output
    assert re.search(r"^ticks +30$", result.output, re.MULTILINE)
    assert "event 2 for $5 and $6; frame 2" in result.output
    figure.unlink()
    found = json.loads(rover("log", path, "--json", "--drive", "0").stdout)
    assert (found["ticks"], found["drives"], len(found["events"])) == (120, 2, 3)
    assert not figure.exists()
    other = path.parent / "other.pdf"
    assert json.loads(rover("log", path, "--json", "-o", other).stdout)["ticks"] == 30
    assert other.read_bytes().startswith(b"%PDF")
    for name in ("other", "other.txt"):
        refused = rover("log", path, "-o", path.parent / name)
        assert refused.exit_code == 1 and "no figure has that ending, found" in refused.output
