"""Examine an emulated Pi that is provisioned and has a model: its packages, its service's sandbox and restarts.

    sandbox(pi)["exposure"]             # 0.8, as systemd-analyze says
    hang(pi, pins)["restarted_s"]       # 2.7, by systemd's watchdog

Each function returns what it found; container_run.py compares that with the gates.
"""

import contextlib
import json
import os
import re
import shlex
import signal
import time
from importlib.metadata import distributions
from pathlib import Path
from typing import Any

from lab.pi.container import Container
from lab.pi.emulation import EmulationError, wait_for
from lab.pi.pulses import Pins, moving, stopped
from rover_lib.onboard.drive.service import UNIT
from rover_lib.workshop.wheelhouse import REQUIREMENTS, VIEW

VENV, STATE = "/opt/rover/venv", "/var/lib/rover-drive"
READY_S = 600  # how long the service may take until it can drive, with emulated torch on a busy machine
DRIVES_S = 30.0  # from a request until the car drives


def environment(root: Path, engine: str = "torch") -> dict[str, Any]:
    """Return what is installed for the policy.

    engine: a key of REQUIREMENTS. packages: each with name, version and what vouches for it. unhashed: those for which
    nothing vouches, and lerobot. lerobot: whether that is installed. missing: needed packages that are not installed.
    others: engines that are installed beside `engine`. of_view: packages that only the view needs. size_mb: of all.
    """
    site = next((root / VENV.lstrip("/") / "lib").glob("python3*/site-packages"))
    pinned, of_view = hashed(REQUIREMENTS[engine]), hashed(VIEW)
    packages = []
    for found in sorted(distributions(path=[str(site)]), key=lambda d: d.metadata["Name"].lower()):
        name, version = re.sub(r"[-_.]+", "-", found.metadata["Name"]).lower(), found.version
        origin = ""
        if version in pinned.get(name, ()):
            origin = f"{REQUIREMENTS[engine].name}, by hash"
        elif version in of_view.get(name, ()):
            origin = f"{VIEW.name}, by hash"
        elif name == "rover-policy":
            origin = "the rover's own wheel"
        elif name in ("pip", "setuptools"):
            origin = "Debian's python3-venv"
        packages.append({"name": name, "version": version, "from": origin})
    venv = root / VENV.lstrip("/")
    sizes = {(s.st_dev, s.st_ino): s.st_blocks * 512 for p in venv.rglob("*") if (s := p.lstat())}
    names = {p["name"] for p in packages}
    return {
        "packages": packages,
        "unhashed": [p["name"] for p in packages if not p["from"] or p["name"] == "lerobot"],
        "lerobot": "lerobot" in names,
        "missing": sorted({engine, "numpy", "opencv-python-headless", "pyserial"} - names),
        "others": sorted((REQUIREMENTS.keys() - {engine}) & names),
        "of_view": sorted(p["name"] for p in packages if p["from"].startswith(VIEW.name)),
        "size_mb": round(sum(sizes.values()) / 1e6),
    }


def hashed(requirements: Path) -> dict[str, set[str]]:
    """Return by name the versions that a requirements file pins with at least one hash."""
    found: dict[str, set[str]] = {}
    for entry in re.split(r"\n(?=\S)", requirements.read_text()):
        if (pin := re.match(r"([A-Za-z0-9._-]+)==([^\s;\\]+)", entry)) and "--hash=sha256:" in entry:
            found.setdefault(re.sub(r"[-_.]+", "-", pin[1]).lower(), set()).add(pin[2])
    return found


PROBE = "/opt/rover/probe.py"
PROBES = r"""
import json, os, pathlib, socket, sys

def writes(path):
    pathlib.Path(path).write_text("x")
    os.unlink(path)

def connects(port):
    socket.create_connection(("127.0.0.1", port), 5).close()

def sends():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
        s.connect(("192.0.2.1", 9))  # of no network; a route is all that this asks for
        s.send(b"x")

def has_route():
    socket.socket(socket.AF_INET, socket.SOCK_STREAM).close()

def asks_kernel():
    socket.socket(socket.AF_NETLINK, socket.SOCK_RAW).close()

def interfaces():
    names = {line.partition(":")[0].strip() for line in open("/proc/net/dev") if ":" in line}
    assert names - {"lo"}, "only lo"

found = {}
def probe(name, action, *arguments):
    try:
        action(*arguments)
        found[name] = ""
    except (OSError, AssertionError) as error:
        found[name] = f"{type(error).__name__}: {error}"

given = json.loads(sys.argv[1])
for path in given["write"]:
    probe(f"write {path}", writes, path)
for path in given["read"]:
    probe(f"read {path}", os.listdir, path)
probe("connect to a port of this machine", connects, given["port"])
probe("send to another machine", sends)
probe("open a network socket", has_route)
probe("ask the kernel about networks", asks_kernel)
probe("see a network", interfaces)

writable = []
for folder, folders, files in os.walk("/"):
    folders[:] = [f for f in folders if os.path.join(folder, f) not in ("/proc", "/sys")]
    if os.access(folder, os.W_OK):
        name = os.path.join(folder, ".probe")
        try:
            writes(name)
            writable.append(folder)
        except OSError:
            pass
print("PROBED", json.dumps({"found": found, "writable": sorted(writable)}))
"""
OPEN = "/etc/rover-open"  # outside of the sandbox, anybody may write there
# The service may write its state, its runtime folder (which says what model it has loaded), and its own /tmp, which
# nobody else sees and which ends with it.
ALLOWED = (STATE, "/run/rover-drive", "/tmp", "/var/tmp")


def sandbox(pi: Container) -> dict[str, Any]:
    """Run probes in the service's own unit, of which only the program is replaced, and run the same probes outside.

    A probe proves that the sandbox refuses something only if it works for the same user outside of it.
    """
    (pi.root / PROBE.lstrip("/")).write_text(PROBES)
    homes = ["/home/pi", "/root"]
    open_folder = pi.root / OPEN.lstrip("/")
    open_folder.mkdir(exist_ok=True)
    open_folder.chmod(0o777)
    before = {home: (pi.root / home.lstrip("/")).stat().st_mode & 0o7777 for home in homes}
    given = json.dumps({"write": [f"{STATE}/probe", f"{OPEN}/probe"], "read": homes, "port": pi.port})
    argv = f"{VENV}/bin/python {PROBE} {shlex.quote(given)}"
    try:
        for home in homes:
            (pi.root / home.lstrip("/")).chmod(0o755)
        installed = (pi.root / "etc/systemd/system" / UNIT).read_text()
        inside = json.loads(probe(pi, "rover-probe.service", unit_for(installed, argv)))
        plain = ["[Service]", "Type=oneshot", "User=rover", "StateDirectory=rover-drive", f"ExecStart={escaped(argv)}"]
        outside = json.loads(probe(pi, "rover-probe-outside.service", "\n".join(plain) + "\n"))
    finally:
        for home, mode in before.items():
            (pi.root / home.lstrip("/")).chmod(mode)
        (pi.root / PROBE.lstrip("/")).unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            open_folder.rmdir()
    analysis = pi.inside("systemd-analyze", "security", "--no-pager", UNIT, check=False).stdout
    exposure = re.search(r"Overall exposure level for \S+: ([\d.]+)", analysis)
    wanted = f"write {STATE}/probe"
    probes = [
        {"probe": n, "refused": n != wanted, "inside": inside["found"][n], "outside": outside["found"][n]}
        for n in inside["found"]
    ]
    if inside["found"][wanted]:
        raise EmulationError(f"the service cannot write to its own {STATE}: {inside['found'][wanted]}")
    beyond = [f for f in inside["writable"] if f not in ALLOWED and not f.startswith(tuple(f"{a}/" for a in ALLOWED))]
    probes.append({"probe": "write anywhere else", "refused": True, "inside": "refused" if not beyond else "",
                   "outside": ""})  # fmt: skip
    return {
        "exposure": float(exposure[1]) if exposure else None,
        "probes": probes,
        "writable": inside["writable"],
        "writable_outside": outside["writable"],
        "beyond": beyond,
    }


def unit_for(text: str, argv: str) -> str:
    """Return the drive service's unit for another program, which is started once and sends systemd no notifications."""
    drop = ("ExecStart", "ExecStartPre", "NotifyAccess", "WatchdogSec", "WatchdogSignal", "Restart", "RestartSec",
            "ConditionPathExists", "StartLimitIntervalSec", "StartLimitBurst", "Type", "WantedBy")  # fmt: skip
    lines = [line for line in text.splitlines() if line.partition("=")[0] not in drop]
    at = lines.index("[Service]") + 1
    return "\n".join([*lines[:at], "Type=oneshot", f"ExecStart={escaped(argv)}", *lines[at:]]) + "\n"


def escaped(argv: str) -> str:
    """Escape a command for a unit, so that % and $ stand for themselves."""
    return argv.replace("%", "%%").replace("$", "$$")


def probe(pi: Container, name: str, unit: str) -> str:
    """Start a unit once; return what its program printed after "PROBED "."""
    (pi.root / "etc/systemd/system" / name).write_text(unit)
    try:
        pi.inside("systemctl", "daemon-reload")
        started = pi.inside("systemctl", "start", name, check=False)
        journal = pi.inside("journalctl", f"--unit={name}", "--output=cat", "--no-pager").stdout
        found = [line for line in journal.splitlines() if line.startswith("PROBED ")]
        if not found:
            raise EmulationError(f"{name} could not look: {started.stderr} {journal[-800:]}")
        return found[-1].removeprefix("PROBED ")
    finally:
        (pi.root / "etc/systemd/system" / name).unlink()


def arm(pi: Container, pins: Pins) -> float:
    """Arm the car and wait until it moves; return when it was asked to (monotonic seconds)."""
    asked_s = time.monotonic()
    pi.inside(f"{VENV}/bin/rover", "arm-car", "--yes")
    if not wait_for(lambda: moving(pins.since(asked_s)), DRIVES_S):
        raise EmulationError(f"the car does not drive, its service says: {show(pi, 'StatusText')['StatusText']}")
    return asked_s


def hang(pi: Container, pins: Pins) -> dict[str, Any]:
    """Hang the loop's process by SIGSTOP while it drives. All times are in seconds from then.

    stopped_s: until the throttle pulses of the Arduino were neutral. killed_s: until systemd's watchdog had killed it.
    restarted_s: until systemd started it again. running_s: until its program ran, after ExecStartPre=, which takes
    milliseconds on a Pi. ready_s: until it could drive, most of which is torch under emulation.
    disarmed: whether it was ready but not armed afterwards, and no pulse has moved the car from a second after on.
    """
    pi.inside("systemctl", "reset-failed", UNIT, check=False)
    pi.inside("systemctl", "start", UNIT)
    asked_s = arm(pi, pins)
    pid = int(show(pi, "MainPID")["MainPID"])
    here = pi.pid_of(pid)
    at_s = time.monotonic()
    os.kill(here, signal.SIGSTOP)
    while _lives(here):
        if time.monotonic() > at_s + 20:
            raise EmulationError("a hung loop was not killed within 20 s")
        time.sleep(0.002)
    killed_s = time.monotonic()
    ready = wait_for(lambda: show(pi, "StatusText", "ActiveState")["StatusText"].startswith("disarmed"), READY_S)
    ready_s = time.monotonic()
    told = show(pi, "InactiveExitTimestampMonotonic", "ExecMainStartTimestampMonotonic", "NRestarts")
    time.sleep(1)
    events = pins.since(asked_s)
    off_ms = stopped(events, at_s)["after_ms"]
    pi.inside("systemctl", "stop", UNIT)
    return {
        "stopped_s": None if off_ms is None else round(off_ms / 1e3, 3),
        "killed_s": round(killed_s - at_s, 2),
        "restarted_s": round(int(told["InactiveExitTimestampMonotonic"]) / 1e6 - at_s, 2),
        "running_s": round(int(told["ExecMainStartTimestampMonotonic"]) / 1e6 - at_s, 2),
        "ready_s": round(ready_s - at_s, 1),
        "restarts": int(told["NRestarts"]),
        "disarmed": ready and not [t for t in moving(events) if t > at_s + 1],
    }


def start_limit(pi: Container) -> dict[str, Any]:
    """Start the service without its camera; return how often systemd tries, and the state 10 s after it gave up."""
    pi.inside("systemctl", "reset-failed", UNIT, check=False)
    camera, away = pi.bench / "camera", pi.bench / "unplugged"
    camera.rename(away)
    try:
        at_s = time.monotonic()
        pi.inside("systemctl", "start", "--no-block", UNIT)
        ended = wait_for(lambda: show(pi, "ActiveState", "SubState")["ActiveState"] == "failed", 180)
        took_s = time.monotonic() - at_s
        time.sleep(10)
        told = show(pi, "ActiveState", "NRestarts", "Result", "StatusText")
    finally:
        away.rename(camera)
    journal = pi.inside("journalctl", f"--unit={UNIT}", "--output=cat", "--no-pager", f"--since=-{took_s + 15:.0f}s")
    pi.inside("systemctl", "reset-failed", UNIT, check=False)
    return {
        "tries": len(re.findall(rf"^Starting {re.escape(UNIT)}", journal.stdout, re.M)),
        "ended": ended,
        "seconds": round(took_s, 1),
        "state": told["ActiveState"],
        "result": told["Result"],
        "said": next((line for line in journal.stdout.splitlines() if line.startswith("rover: ")), ""),
    }


def show(pi: Container, *names: str, unit: str = UNIT) -> dict[str, str]:
    """Return what systemd says about a service, by default the drive's."""
    told = pi.inside("systemctl", "show", f"--property={','.join(names)}", unit).stdout
    found = dict(line.partition("=")[::2] for line in told.splitlines())
    return {name: found.get(name, "") for name in names}


def _lives(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False
