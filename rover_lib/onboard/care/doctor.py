"""Check everything that driving needs, and say in one line each what was found and what to do about it.

"fail" means that the car would not drive, "warning" that it would drive worse or stop more often than it could.
"""

import contextlib
import getpass
import os
import shutil
import statistics
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from rover_lib.onboard.artifact.manifest import car_of, read_manifest, seen_size
from rover_lib.onboard.car.camera import Camera, Frame, check_shape, path_of, size_like
from rover_lib.onboard.car.car import car_file, this_car
from rover_lib.onboard.car.gamepad import list_gamepads, open_gamepad
from rover_lib.onboard.car.host import Host, throttled_means
from rover_lib.onboard.car.ports import DEV, find_port, list_ports
from rover_lib.onboard.car.protocol import PROTOCOL_VERSION, Telemetry
from rover_lib.onboard.car.servo_link import ServoLink
from rover_lib.onboard.drive.flight_log import log_limits
from rover_lib.onboard.drive.inference import PolicyProcess
from rover_lib.onboard.drive.motion import EVERY_S, MOVED, cells_of, difference
from rover_lib.onboard.drive.pilot import blank, frozen
from rover_lib.onboard.drive.plan import STOP, Settings
from rover_lib.onboard.errors import ArtifactError, RoverError
from rover_lib.onboard.params import params

NAME_WIDTH = 15
RATE_SHARE = 0.9  # of the requested frame rate must be reached
SETTLE_S, MEASURE_S = 0.5, 1.0  # a camera first has to find its exposure
LATEST = {"frozen_frames": 30, "black_frames": 30, "stuck_s": 10, "undervoltage_s": 60}  # more is as good as off
ROUND_TRIPS = 20
SLOW_MS = 20.0  # an answer takes 3 to 8 ms: 40 bytes at 115200 baud and the USB adapter's 1 ms
SIGNAL_S = 1.0
RITUAL_S = 30.0  # time for a human to do what is asked
REST_US = 32  # the firmware arms only with the throttle stick this near to neutral
MEMORY_MB = 700  # the real policy needs 358 MB while predicting and 424 while loading, the loop's process 100
RECORDINGS_MB = 1000  # a quarter of an hour at 30 Hz

Verdict = Literal["ok", "warning", "fail"]


@dataclass(frozen=True)
class Check:
    """The result of one check. name: what was checked. remedy: what to do, empty if nothing."""

    name: str
    verdict: Verdict
    found: str
    remedy: str = ""

    def __str__(self) -> str:
        line = f"{self.verdict:<8} {self.name:<{NAME_WIDTH}} {self.found}"
        return f"{line}\n{'':{9 + NAME_WIDTH}} {self.remedy}" if self.remedy else line


def warn_unless(fine: bool, name: str, found: str, remedy: str) -> Check:
    """Return an "ok" if it is fine, and otherwise a "warning" with its remedy."""
    return Check(name, "ok", found) if fine else Check(name, "warning", found, remedy)


def examine(
    artifact: Path | str | None = None,
    *,
    camera: str = "0",
    port: str = "",
    rate_hz: float = 30.0,
    log_folder: Path | None = None,
    host: Host | None = None,
) -> Iterator[Check]:
    """Run all checks, and yield each result as soon as it is known. Raises nothing: a check that breaks has failed.

    artifact: the policy to check. camera, port: as for `rover drive`. log_folder: where flight logs go [this folder].
    """
    host = host or Host()
    manifest = size = None
    with contextlib.suppress(ArtifactError, OSError):  # the artifact's own check reports it
        if artifact:
            manifest = read_manifest(artifact)
            size = seen_size(manifest)
    device = path_of(str(camera))
    checks: dict[str, Callable[[], Iterable[Check]]] = {}
    if device.is_relative_to(DEV):  # otherwise it is a file or a pipe, and no camera needs to be there
        checks["group video"] = lambda: access("group video", device)
    checks |= {
        "camera": lambda: camera_rate(device, size, rate_hz=rate_hz),
        "group dialout": lambda: access("group dialout", Path(port or next(iter(list_ports()), DEV / "none"))),
        "Arduino": lambda: arduino(port or find_port()),
        "ModemManager": lambda: modem_manager(host.proc_root),
        "car": lambda: car(manifest),
        "stops": lambda: stops(manifest),
        "artifact": lambda: policy(artifact),
        "power": lambda: power(host),
        "governor": lambda: governor(host.sys_root),
        "disk": lambda: disk(log_folder or Path.cwd(), Path.cwd()),
        "memory": lambda: memory(host.proc_root),
    }
    for name, check in checks.items():
        try:
            yield from check()
        except RoverError as error:
            finding = error.what if error.found is None else f"{error.what}, found {error.found}"
            yield Check(name, "fail", finding, error.remedy)
        except Exception as error:
            yield Check(name, "fail", f"could not be checked: {type(error).__name__}: {error}", "report this, please")


def access(name: str, device: Path) -> Iterator[Check]:
    """Check whether this user may use the device, if it is there; another check reports a missing one."""
    if not device.exists():
        return
    user = getpass.getuser()
    group = device.group()
    remedy = f"sudo usermod -aG {group} {user}, then log in again (or restart the service)"
    if os.access(device, os.R_OK | os.W_OK):
        yield Check(name, "ok", f"{user} may use {device}")
    else:
        yield Check(name, "fail", f"{user} may not use {device}, of group {group}", remedy)


def camera_rate(source: Path | str, seen: tuple[int, int] | None = None, *, rate_hz: float = 30.0) -> Iterator[Check]:
    """Measure for a second what the camera really delivers: frame rate, size, whether anything can be seen, and light.

    In light that changes too much, the pictures of a stuck car look like those of a moving one. The car must stand.

    seen: (width, height) of the pictures that the policy was made with. Raises CameraError for another shape.
    """
    with Camera(source, rate_hz=rate_hz, size=size_like(*(seen or (16, 9)))) as camera:
        first, _ = _watch(camera, SETTLE_S)
        last, change = _watch(camera, MEASURE_S)
        clock = camera.time_stamps
        if seen:
            check_shape(str(source), last.image, seen)
    number = last.number - first.number
    measured_hz = 0.0
    if last.captured_s > first.captured_s:
        measured_hz = number / (last.captured_s - first.captured_s)
    height, width = last.image.shape[:2]
    finding = f"{source}: {width}x{height}, {clock} time stamps, {measured_hz:.1f} frames a second"
    settings = Settings.of(params()["drive"])
    if not measured_hz:
        yield Check("camera", "fail", f"{source}: no new frame within {MEASURE_S:g} s", "plug it in again")
        return
    if fault := frozen(last, settings) or blank(last, settings):
        yield Check("camera", "fail", f"{finding}, but {fault.what}", fault.remedy)
        return
    wanted = "" if (fast := measured_hz >= RATE_SHARE * rate_hz) else f", wanted {rate_hz:g}"
    remedy = "more light (long exposures halve the rate), a USB 3 port, or --hz of what it gives"
    yield warn_unless(fast, "camera", finding + wanted, remedy)
    light = f"standing pictures differ by {change:.1f}, a moving car's by over {MOVED:g}; mean {last.mean:.0f} of 255"
    if change > MOVED:
        light += ": a car that is stuck would not be stopped"
    yield warn_unless(change <= MOVED, "light", light, "brighter light that does not flicker, and nothing moving in it")


def _watch(camera: Any, seconds: float) -> tuple[Frame, float]:
    """Return the newest frame after some time, and how far the pictures were from the first, as motion.py sees it."""
    end = time.monotonic() + seconds
    last = camera.latest()
    first = cells_of(last.image)
    seen_s = last.captured_s
    change = 0.0
    while (rest_s := end - time.monotonic()) > 0 and (frame := camera.wait(last.number, rest_s)):
        last = frame
        if last.captured_s - seen_s >= EVERY_S:
            seen_s = last.captured_s
            change = max(change, difference(cells_of(last.image), first))
    return last, change


def arduino(port: str) -> Iterator[Check]:
    """Check that the port is free, what answers on it and how fast, and the transmitter. Raises LinkError."""
    with ServoLink(port) as link:
        firmware = link.hello.firmware if link.hello else "unknown"
        yield Check("Arduino", "ok", f"{port}: firmware {firmware}, protocol {PROTOCOL_VERSION}")
        times_ms = [link.round_trip_s() * 1000 for _ in range(ROUND_TRIPS)]
        median_ms = statistics.median(times_ms)
        most_ms = max(times_ms)
        finding = f"round trip {median_ms:.1f} ms median, {most_ms:.1f} ms at most of {ROUND_TRIPS}"
        if link.garbled:
            finding += f"; {link.garbled} lines were garbled"
        remedy = "a shorter or better USB cable, plugged into the Pi itself, not a hub"
        yield warn_unless(median_ms <= SLOW_MS and not link.garbled, "link", finding, remedy)
        yield _transmitter(link)


def _transmitter(link: ServoLink) -> Check:
    steering_us, throttle_us = _soon(link, lambda status: None not in status.receiver[:2], SIGNAL_S).receiver[:2]
    if steering_us is None or throttle_us is None:
        if link.car.human == "gamepad":
            return Check("transmitter", "warning", "nobody holds L1: arming will be refused", "hold L1 of the gamepad")
        finding = f"no signal (steering {steering_us}, throttle {throttle_us}): arming will be refused"
        remedy = "switch it on; if the car is another, rover calibrate; then look at the wires (firmware/README.md)"
        return Check("transmitter", "fail", finding, remedy)
    finding = f"steering {steering_us} us, throttle {throttle_us} us"
    rests = abs(throttle_us - link.calibration.throttle.pulse_us(0.0)) <= REST_US
    if not rests:
        finding += ": arming will be refused"
    return warn_unless(rests, "transmitter", finding, "let go of the throttle")


def receiver(port: str, ask: Callable[[str], object]) -> Iterator[Check]:
    """Lead a human once through the steps of arming, and see what the receiver sends while its transmitter is off.

    ask: tells the human what to do, and returns when it is done. Nothing is armed. Raises LinkError like ServoLink.
    """
    with ServoLink(port) as link:
        ask("Jack up the car. Switch the transmitter on, and let go of it.")
        check = _transmitter(link)
        yield check
        if check.verdict != "ok":
            return
        ask("Steer far to both sides, and let go.")
        answer = _soon(link, lambda status: status.missing == "-", RITUAL_S)
        if answer.missing != "-":
            yield Check("arming", "fail", "the receiver's pulses did not show it", link.remedy(answer.missing))
            return
        yield Check("arming", "ok", "transmitter on, throttle at rest, stick wiggled: it could be armed for 30 s now")
        ask("Switch the transmitter off.")
        after = _soon(link, lambda status: None in status.receiver[:2], SIGNAL_S)
        yield _failsafe(after.receiver[:2], link.calibration.throttle.pulse_us(0.0))
        ask("Switch the transmitter on again.")


def _soon(link: ServoLink, condition: Callable[[Telemetry], bool], seconds: float) -> Telemetry:
    """Wait for a status that meets the condition, and return it; after `seconds`, return the newest one."""
    end = time.monotonic() + seconds
    while True:
        telemetry = link.latest()
        assert telemetry, "an open link has a status"
        if condition(telemetry) or time.monotonic() > end:
            return telemetry
        time.sleep(0.02)


def _failsafe(after: tuple[int | None, ...], rest_us: int) -> Check:
    name = "failsafe"
    remedy = "set the receiver's failsafe to no pulses (its manual says how), then run this again"
    if None in after:
        return Check(name, "ok", "without its transmitter the receiver sends no pulses: the car stops within 100 ms")
    steering_us, throttle_us = (us or 0 for us in after)
    finding = f"without its transmitter the receiver goes on: steering {steering_us} us, throttle {throttle_us} us"
    if abs(throttle_us - rest_us) > REST_US:
        return Check(name, "fail", f"{finding}: a car that a human drives runs away", remedy)
    return Check(name, "warning", f"{finding}: an armed car may drive on, and nobody can tell", remedy)


def car(manifest: dict[str, Any] | None = None) -> Iterator[Check]:
    """Say which car this is, and warn if the artifact was calibrated for another. If its human has a gamepad, open it.

    manifest: the artifact's. Raises CarError for a bad car.yml or gamepad.
    """
    this = this_car()
    path = car_file()
    yield Check("car", "ok", f"{this.name}, of {path}" if path else f"{this.name}: no car.yml is here")
    if this.human == "gamepad":
        open_gamepad().close()
        pads = ", ".join(map(str, list_gamepads()))
        yield Check("gamepad", "ok", f"{pads}: with L1 held, the left stick steers, and the right one is the throttle")
    if manifest and (unlike := (meant := car_of(manifest)).unlike(this)):
        remedy = "deploy one that was calibrated with recordings of this car, or put its car.yml here"
        finding = f"the artifact was calibrated for another car: {unlike}"
        yield Check("car", "warning" if meant.positive == this.positive else "fail", finding, remedy)


def stops(manifest: dict[str, Any] | None = None) -> Iterator[Check]:
    """Name the stops that params.yml switches off, or delays by so much that they are. manifest: the artifact's."""
    settings = Settings.of(params()["drive"])
    off = [] if settings.unfamiliar == STOP else [f"unfamiliar: {settings.unfamiliar}"]
    off += [f"{name}: 0" for name in ("stuck_s", "undervoltage_s") if not getattr(settings, name)]
    off += [f"{name}: {value:g}" for name in ("black_level", "flat_level") if (value := getattr(settings, name)) <= 0]
    off += [f"{name}: {value}" for name, limit in LATEST.items() if (value := getattr(settings, name)) > limit]
    if manifest is not None and "familiar" not in manifest:
        off.append("unfamiliar: this artifact knows no limit")
    finding = f"off or late: {', '.join(off)}" if off else "all that params.yml may switch off are on"
    yield warn_unless(not off, "stops", finding, "see drive in params.yml, and docs/safety.md for what each prevents")


def modem_manager(proc_root: Path = Path("/proc")) -> Iterator[Check]:
    """Check whether ModemManager runs, because it writes to every new serial port."""
    runs = False
    for process in proc_root.glob("[0-9]*"):
        with contextlib.suppress(OSError):  # it has just ended
            runs |= (process / "comm").read_text().strip() == "ModemManager"
    finding = "runs: it writes to serial ports that appear" if runs else "does not run"
    yield warn_unless(not runs, "ModemManager", finding, "sudo systemctl disable --now ModemManager")


def policy(artifact: Path | str | None) -> Iterator[Check]:
    """Check the artifact's checksums, manifest and parity vectors, and how long one inference takes."""
    if artifact is None:
        yield Check("artifact", "warning", "none was named, so none was looked at", "name it: rover doctor ARTIFACT")
        return
    times_s = []
    with PolicyProcess(artifact) as process:
        loaded = process.manifest
        camera = loaded["cameras"][0]
        size = f"{camera['name']} {camera['width']}x{camera['height']}"
        description = f"{loaded['mode']}, {loaded['chunk']} actions at {loaded['rate_hz']:g} Hz, camera {size}"
        yield Check("artifact", "ok", f"{artifact}: verified; {description}")
        finding = process.unconfined or "the policy's process opens no file to write, no port and no socket"
        remedy = "a kernel with seccomp, as Raspberry Pi OS has; until then drive only what you made"
        yield warn_unless(not process.unconfined, "confinement", finding, remedy)
        frame = np.zeros((camera["height"], camera["width"], 3), np.uint8)
        for _ in range(3):
            start = time.perf_counter()
            process.predict(frame, np.zeros(2, np.float32))
            times_s.append(time.perf_counter() - start)
    median_s = statistics.median(times_s)
    fade_s = float(params()["drive"]["fade_s"])
    # just before the next plan is ready, a plan is two inferences old
    finding = f"{1000 * median_s:.0f} ms; the throttle fades from {1000 * fade_s:g} ms of age on"
    remedy = "choose a static artifact or a smaller image, cool the processor, end what else runs"
    yield warn_unless(median_s < fade_s / 2, "inference", finding, remedy)


def power(host: Host) -> Iterator[Check]:
    """Check what get_throttled reports about the supply and the clock, now and since the machine started."""
    value = host.throttled()
    means = throttled_means(value)
    if means is None:
        trouble = shutil.which(host.vcgencmd)
        finding = "cannot be read, so low voltage would not be seen" if trouble else "no vcgencmd here"
        yield warn_unless(not trouble, "power", finding, "sudo usermod -aG video $USER, log in again")
        return
    supply = any("voltage" in m for m in means)
    remedy = "a supply of 5 V and 5 A with a short thick cable; a charged battery" if supply else "a fan, or air"
    yield warn_unless(not means, "power", f"get_throttled {value}: {', '.join(means) or 'nothing'}", remedy)


def governor(sys_root: Path = Path("/sys")) -> Iterator[Check]:
    """Check which frequency governor sets the cores' clock."""
    files = sorted(sys_root.glob("devices/system/cpu/cpu[0-9]*/cpufreq/scaling_governor"))
    governors = sorted({f.read_text().strip() for f in files})
    remedy = "echo performance | sudo tee /sys/devices/system/cpu/cpu*/cpufreq/scaling_governor"
    fine = governors in ([], ["performance"])
    yield warn_unless(fine, "governor", ", ".join(governors) or "not reported", remedy)


def disk(log_folder: Path, recordings: Path) -> Iterator[Check]:
    """Check that there is room for flight logs and recordings, and that their folders can be written."""
    max_bytes, keep = log_limits()
    log_mb = max_bytes / 1e6 * (keep + 1)
    for purpose, folder, need_mb in (("flight logs", log_folder, log_mb), ("recordings", recordings, RECORDINGS_MB)):
        there = next(p for p in (folder, *folder.absolute().parents) if p.exists())
        free_mb = shutil.disk_usage(there).free / 1e6 if os.access(there, os.W_OK | os.X_OK) else 0
        finding = f"{free_mb:.0f} MB free to write {purpose} to {folder}, {need_mb:.0f} are wanted"
        yield warn_unless(free_mb >= need_mb, "disk", finding, f"delete what is old, or sudo chown $USER {there}")


def memory(proc_root: Path = Path("/proc")) -> Iterator[Check]:
    """Check that enough memory is free for the policy."""
    rows = dict(line.split(":", 1) for line in (proc_root / "meminfo").read_text().splitlines() if ":" in line)
    free_mb = int(rows["MemAvailable"].split()[0]) * 1024 / 1e6
    remedy = "end other programs (a desktop needs 500 MB: sudo systemctl set-default multi-user.target)"
    yield warn_unless(free_mb >= MEMORY_MB, "memory", f"{free_mb:.0f} MB free, {MEMORY_MB} are wanted", remedy)
