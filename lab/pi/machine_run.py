"""`make pi`: go from a flashed card to servo pulses, on a whole emulated Pi.

A camera frame goes in at the kernel's /dev/video0, the INT8 policy runs on four emulated Cortex-A76, and commands leave
by a USB serial adapter. The project's firmware on an emulated Arduino makes servo pulses of them, and each pulse is
compared with what the rover says that it commanded. Then cables are pulled while it drives.

Its times say nothing about a Pi. The machine's clock and the Arduino's run `slow` times slower than the host's
(machine.py, lab/params.yml), which makes the machine about as fast as a Pi by its own clock.
"""

import contextlib
import json
import re
import shutil
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from balloon_world.simulated_arduino import REST_US
from lab.arduino.emulator import EmulatedArduino
from lab.pi import machine, playbooks
from lab.pi.emulation import interruptible, require_arduino, wait_for
from lab.pi.machine import DEBS, Card, Machine, card
from lab.pi.pulses import READ_S, Pins, compare, moving, stopped
from lab.pi.report import PiReport
from lab.pi.usb_camera import UsbCamera
from rover_lib.onboard.artifact.manifest import content_hash
from rover_lib.onboard.drive.flight_log import Flight, read_log
from rover_lib.onboard.drive.service import UNIT
from rover_lib.onboard.errors import RoverError
from rover_lib.workshop.cache import cache_folder, cache_root, key_of

STAGE = "pi"
REPOSITORY = Path(__file__).parents[2]
PORT, CAMERA, MODEL = "/dev/rover-arduino", "/dev/video0", "/var/lib/rover/models/current/policy.pt"
SIZE = (640, 360)
FRAMES = 150  # how many of the recordings' are shown, which is 5 s
TWICE = 2  # each frame is shown twice: vivid's HDMI has no 30 Hz at this size, only 60
# The camera is the kernel's vivid: frames written to its output come out of its input, as through an HDMI cable.
SCREEN = "rover-screen"
SHOW = f"""set -e
modprobe vivid n_devs=1 node_types=0x101 num_inputs=1 input_types=0x3 num_outputs=1 output_types=0x1
udevadm settle
test -e {CAMERA} -a -e /dev/video1
for d in {CAMERA} /dev/video1; do v4l2-ctl -d $d --set-dv-bt-timings cvt,width={SIZE[0]},height={SIZE[1]},fps=60; done
v4l2-ctl -d {CAMERA} --set-fmt-video=width={SIZE[0]},height={SIZE[1]},pixelformat=YUYV
v4l2-ctl -d /dev/video1 --set-fmt-video-out=width={SIZE[0]},height={SIZE[1]},pixelformat=YUYV
v4l2-ctl -d {CAMERA} -c loop_video=1
systemctl reset-failed {SCREEN} 2> /dev/null || true
systemd-run --quiet --unit={SCREEN} v4l2-ctl -d /dev/video1 --stream-out-mmap --stream-from=/dev/vdb --stream-loop
"""
HIDE = f"systemctl stop {SCREEN}; modprobe -r vivid"
WATCH_S = 2.0  # how long the pins are watched after a fault, in the rover's time


class MachineRunError(RoverError):
    """A step of the whole machine did not do what it should."""


def run_machine(
    output: Path | str,
    artifact: Path | str,
    recordings: Path | str,
    *,
    fresh: bool = False,
    say: Callable[[str], None] = print,
) -> PiReport:
    """Run everything; return the report, which is written to `output` even if a step fails.

    artifact: to deploy. recordings: episodes, whose frames the camera shows. fresh: provision a new card, even if one
    that was provisioned with these requirements is in the cache. say: called with each step. Raises RoverError if it
    cannot begin. If anything is wrong, the machine's console and Ansible's output are left beside `output`.
    """
    output, artifact, recordings = Path(output), Path(artifact), Path(recordings)
    require_arduino()
    if not artifact.is_file():
        raise MachineRunError(f"{artifact}: no artifact to deploy; make demo leaves one")
    report = PiReport(STAGE, output, say, {artifact.name: content_hash(artifact)})
    kept = output.with_suffix("")
    shutil.rmtree(kept, ignore_errors=True)
    with (
        interruptible(),
        tempfile.TemporaryDirectory(prefix=".pi-whole.", dir=_cache()) as scratch,  # too large for /tmp
        tempfile.TemporaryDirectory(prefix="rover-plays-") as ansible,  # ssh's sockets want a short path
    ):
        run = _Run(report, Path(scratch), Path(ansible))
        try:
            run.all(artifact, recordings, fresh)
        except RoverError as error:
            report.wrong.append(str(error))
        if report.wrong:
            kept.mkdir(parents=True)
            for file in Path(scratch).rglob("*.log"):
                shutil.copy(file, kept / "-".join(file.relative_to(scratch).parts))
            report.metrics["kept"] = str(kept)
    report.write()
    return report


def _cache() -> Path:
    cache_root().mkdir(parents=True, exist_ok=True)
    return cache_root()


class _Run:
    def __init__(self, report: PiReport, folder: Path, ansible: Path):
        self.report, self.folder, self.ansible = report, folder, ansible
        self.gates = report.gates
        self.slow = float(self.gates["slow"])
        self.zero_s = 0.0
        report.metrics |= {"slow": self.slow, "faults": []}
        self.pi: Machine
        self.pins: Pins

    def all(self, artifact: Path, recordings: Path, fresh: bool) -> None:
        start = time.monotonic()
        metrics = self.report.metrics
        with self.report.step("the card, as flashed"):
            flashed = card()
        layer = self.provisioned(flashed, fresh)
        with self.report.step("the frames that the camera will show"):
            frames = _frames(recordings, self.folder / "frames.yuyv")
        with contextlib.ExitStack() as on:
            self.pi = on.enter_context(Machine(flashed, self.folder, layer=layer, slow=self.slow, drives=[frames]))
            board = on.enter_context(EmulatedArduino(transmitter=REST_US, ready=True, slow=self.slow, nice=-5))
            self.pins = on.enter_context(Pins(board))
            self.pi.plug(board.port)
            with self.report.step("boot, until ssh answers"):
                self.pi.wait_for_ssh()
            self.zero_s = self.clock()
            metrics["machine"] = self.machine()
            with self.report.step("camera and Arduino"):
                self.sudo(SHOW)
                self.until(f"test -e {PORT}", f"no {PORT} although the adapter is plugged in")
            with self.report.step("provision.yml again") as row:
                row["recap"] = self.provision()
            with self.report.step("deploy.yml") as row:
                row["recap"] = self.play(
                    "deploy", rover_artifact=artifact.resolve(), rover_packed=self.folder / "packed"
                )
            with self.report.step("drive.yml: doctor, start, arm, drive, stop, fetch") as row:
                row["recap"] = self.drive(metrics)
            self.fault("USB serial unplugged while driving, by QMP", self.pi.unplug, lambda: self.pi.plug(board.port))
            with self.report.step("another camera, on USB"):
                self.sudo(HIDE)
                usb = on.enter_context(UsbCamera([p.read_bytes() for p in _pictures(recordings)], slow=self.slow))
                self.pi.plug_camera(usb.path)
                self.until(f"test -e {CAMERA}", f"no {CAMERA} although the USB camera is plugged in")
            self.fault(
                "USB camera unplugged while driving, by QMP",
                lambda: self.pi.unplug(machine.CAMERA),
                lambda: self.pi.plug_camera(usb.path),
            )
        metrics["seconds"] = round(time.monotonic() - start, 1)
        if metrics["provisioned"] != "now" and metrics["seconds"] > self.gates["minutes"] * 60:
            self.wrong(f"it took {metrics['seconds'] / 60:.0f} minutes, {self.gates['minutes']} are allowed")

    # -- provisioning

    def provisioned(self, flashed: Card, fresh: bool) -> Path:
        """Return a card as provision.yml left it with these requirements, from the cache or made now.

        The rest of the role, and the rover's own wheel, may have changed since. So provision.yml runs on it each time.
        """
        requirements = REPOSITORY / "requirements_pi.txt"
        key = key_of({"card": str(flashed.folder)}, requirements)
        if fresh:
            shutil.rmtree(cache_root() / f"pi-provisioned-{key}", ignore_errors=True)
        made: list[bool] = []

        def make(folder: Path) -> None:
            made.append(True)
            with Machine(flashed, self.folder / "first", slow=self.slow) as self.pi:
                with self.report.step("first boot, until ssh answers"):
                    self.pi.wait_for_ssh()
                with self.report.step("Debian packages for a rover without internet"):
                    self.sudo(f"DEBIAN_FRONTEND=noninteractive dpkg --install {DEBS}/*.deb")
                with self.report.step("provision.yml, from a flashed card") as row:
                    row["recap"] = self.provision()
                with self.report.step("shut down"):
                    self.pi.power_off()
                shutil.move(self.pi.disk, folder / "disk.qcow2")

        folder = cache_folder("pi-provisioned", key, make)
        self.report.metrics["provisioned"] = "now" if made else "from the cache, and again"
        return folder / "disk.qcow2"

    def provision(self) -> dict[str, int]:
        # Offline: the machine reaches no network, as at a track, and the wheels come from a folder, fetched only once.
        return self.play("provision", rover_offline=True, rover_wheels=cache_root() / "wheels")

    # -- driving

    def drive(self, metrics: dict[str, Any]) -> dict[str, int]:
        began = time.monotonic()
        seconds = float(self.gates["drive_s"]) * self.slow
        recap = self.play("drive", rover_arm=True, rover_seconds=round(seconds), rover_fetched=self.folder / "fetched")
        time.sleep(2 * READ_S)
        flight = self.fetched()
        events = self.pins.since(began)
        summary = flight.summary()
        pulses = compare(flight, events, lambda s: self.zero_s + self.slow * s, self.slow)
        frame, plan = flight.ticks["frame"], flight.ticks["plan"]
        metrics["drive"] = {
            **{k: v for k, v in summary.items() if k != "events"},
            "frames": int(frame[-1] - frame[0]) if len(frame) else 0,
            "inferences": len(np.unique(plan[plan > 0])),
            "events": [str(e) for e in flight.events],
            "stalled_ms": round(sum(e.pulse_us for e in events if e.kind == "stall") / 1e3, 1),
            "lost": sum(e.kind == "lost" for e in events),
        }
        metrics["pulses"] = pulses
        g = self.gates
        if pulses["worst_us"] is None or pulses["worst_us"] > g["pulse_us"] or pulses["unseen"]:
            self.wrong(f"pulses are not as commanded within {g['pulse_us']} us: {pulses}")
        for name, found in (("ticks", summary["ticks"]), *((n, metrics["drive"][n]) for n in ("inferences", "frames"))):
            if found < g[name]:
                self.wrong(f"{found} {name} in the drive, at least {g[name]} are wanted")
        if any(pulses["distinct"].get(pin, 0) < wanted for pin, wanted in g["distinct"].items()):
            self.wrong(f"the servos hardly moved: {pulses['distinct']} different pulses were commanded")
        return recap

    def fetched(self) -> Flight:
        logs = sorted((self.folder / "fetched").rglob("flight.log"))
        if not logs:
            raise MachineRunError("drive.yml fetched no flight log; its words are in drive.log")
        return read_log(logs[-1])

    def fault(self, name: str, pull: Callable[[], object], put_back: Callable[[], object]) -> None:
        """Pull something out while the car drives; judge the pins and the service, and rover doctor once it is back."""
        with self.report.step(name):
            self.sudo(f"systemctl reset-failed {UNIT}; systemctl start {UNIT}", timeout_s=900)
            self.sudo("rover arm-car --yes")
            began = time.monotonic()
            if not wait_for(lambda: moving(self.pins.since(began)), 5 * self.slow):
                raise MachineRunError(f"{name}: the car did not begin to drive within 5 s of its clock")
            drove_s = moving(self.pins.since(began))[0]
            time.sleep(1.0 * self.slow)
            at_s = time.monotonic()
            pull()
            time.sleep(WATCH_S * self.slow)
            row = {"fault": name, **stopped(self.pins.since(drove_s), at_s, self.slow)}
            row |= {"service": self.service(), "says": self.journal()}
            put_back()
            self.sudo(f"systemctl stop {UNIT}")
            self.until(f"test -e {PORT} -a -e {CAMERA}", f"{PORT} or {CAMERA} is not back")
            self.report.metrics["doctor"] = self.doctor()
            row["doctor"] = self.report.metrics["doctor"]["drives"]
            self.report.metrics["faults"].append(row)
            if not row["drove"] or not row["neutral"] or row["after_line_ms"] > self.gates["neutral_ms"]:
                self.wrong(f"{name}: the pins did not go to neutral as promised: {row}")
            if row["service"].get("StatusText", "").startswith("driving"):
                self.wrong(f"{name}: the service says that it drives on")
            if not row["says"]:
                self.wrong(f"{name}: the service said nothing about it")
            if not row["doctor"]:
                self.wrong(f"{name}: rover doctor is not content after it was put back")

    def service(self) -> dict[str, str]:
        """Return what systemd knows about the service."""
        output = self.pi.ssh(f"systemctl show --property=ActiveState,SubState,Result,NRestarts,StatusText {UNIT}")
        return dict(line.partition("=")[::2] for line in output.splitlines() if "=" in line)

    def journal(self) -> list[str]:
        """Return the last lines of the service's journal about something that is unplugged, missing or plugged in."""
        output = self.sudo(f"journalctl --unit={UNIT} --output=cat --no-pager --lines=60")
        about = re.compile("unplugged|plugged in|no such camera")
        return [line for line in output.splitlines() if about.search(line)][-4:]

    def doctor(self) -> dict[str, Any]:
        """Run `rover doctor` on the rover; return whether the car would drive, and each check."""
        output = self.pi.ssh(
            f"cd / && sudo -u rover rover doctor {MODEL} --camera {CAMERA} --port {PORT} --json",
            check=False,
            timeout_s=900,
        )
        try:
            found = json.loads(output[output.index("{") : output.rindex("}") + 1])
        except ValueError:
            raise MachineRunError(f"rover doctor gave no JSON: {' '.join(output.split())[-400:]}") from None
        if not found["drives"]:
            failed = [f"{c['name']}: {c['found']}" for c in found["checks"] if c["verdict"] == "fail"]
            self.wrong(f"rover doctor: {'; '.join(failed)}")
        return found

    # -- the machine

    def machine(self) -> dict[str, Any]:
        """Return what the machine says that it is: kernel, cores, SDOT, memory, Debian."""
        output = self.pi.ssh(
            "uname -rm; nproc; grep -m1 ^Features /proc/cpuinfo; head -1 /proc/meminfo; cat /etc/debian_version"
        )
        kernel, cores, features, memory, debian = output.splitlines()[:5]
        if "asimddp" not in features:
            self.wrong(f"the machine has no SDOT, which INT8 policies use: {features}")
        about = {"kernel": kernel, "cores": int(cores), "sdot": "asimddp" in features}
        return about | {"memory": memory.split()[1], "debian": debian}

    def clock(self) -> float:
        """Return the host's monotonic time at which the machine's was 0, to some milliseconds of the machine's time."""
        best = (float("inf"), 0.0)
        for _ in range(10):
            before = time.monotonic()
            uptime = float(self.pi.ssh("cat /proc/uptime").split()[0]) + 0.005  # /proc/uptime is cut off to hundredths
            after = time.monotonic()
            best = min(best, (after - before, (before + after) / 2 - self.slow * uptime))
        return best[1]

    def sudo(self, script: str, timeout_s: float = 600) -> str:
        return self.pi.ssh("sudo sh -s", text=script, timeout_s=timeout_s)

    def until(self, test: str, otherwise: str, timeout_s: float = 120) -> None:
        end = time.monotonic() + timeout_s
        while self.pi.ssh(f"{test} && echo yes", check=False).strip() != "yes":
            if time.monotonic() > end:
                raise MachineRunError(otherwise)
            time.sleep(1)

    def play(self, name: str, **variables: object) -> dict[str, int]:
        """Run one of ansible/'s playbooks on the machine; return its recap. Raises MachineRunError if it fails."""
        given = {k: str(v) if isinstance(v, Path) else v for k, v in variables.items()}
        play = playbooks.run(name, [self.pi], folder=self.ansible, variables=given)
        (self.folder / f"{name}.log").write_text(play.output)
        if not play.ok:
            raise MachineRunError(f"{name}.yml failed: {' '.join(play.end.split())[-500:]}")
        return play.recap[self.pi.name]

    def wrong(self, sentence: str) -> None:
        self.report.wrong.append(sentence)


def _pictures(recordings: Path) -> list[Path]:
    """Return the paths of the first frames of the recordings."""
    pictures = sorted(recordings.glob("*/frames/*.jpg"))[:FRAMES]
    if not pictures:
        raise MachineRunError(f"{recordings}: no recorded frames in it; make demo leaves some")
    return pictures


def _frames(recordings: Path, file: Path) -> Path:
    """Write the same frames to a file as vivid takes them: YUYV, one after another."""
    with file.open("wb") as out:
        for path in _pictures(recordings):
            image = cv2.imread(str(path))
            if image is None or image.shape[1::-1] != SIZE:
                found = None if image is None else image.shape
                raise MachineRunError(f"{path}: a frame must be {SIZE[0]}x{SIZE[1]}, found {found}")
            out.write(cv2.cvtColor(image, cv2.COLOR_BGR2YUV_YUY2).tobytes() * TWICE)
    return file
