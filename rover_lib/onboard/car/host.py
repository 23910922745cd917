"""The machine's own state: temperature, clock, throttling, memory. A value that it does not report is None, not 0.

psutil knows neither a process's peak memory on Linux nor what a Raspberry Pi's firmware throttles.
"""

import errno
import os
import re
import socket
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

# Bits of vcgencmd get_throttled: true now, and 16 bits higher: has been true since the start
UNDER_VOLTAGE = "under-voltage"
THROTTLED_BITS = {0: UNDER_VOLTAGE, 1: "frequency capped", 2: "throttled", 3: "soft temperature limit"}
THROTTLED_VALUE = re.compile(r"0x[0-9a-fA-F]{1,8}")  # as get_throttled prints the bits
SUPPLY_VALUE = re.compile(r"EXT5V_V volt\(\d+\)=(\d+\.?\d*)V")  # as a Pi 5's pmic_read_adc prints it


def boottime() -> float:
    """Return the seconds since this machine started, with those in which it was suspended."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


@dataclass(frozen=True)
class Host:
    """Reads the machine's state. Paths and the command are arguments so that tests can replace them."""

    sys_root: Path = Path("/sys")
    proc_root: Path = Path("/proc")
    vcgencmd: str = "vcgencmd"

    def temperature_c(self) -> float | None:
        """Return the processor's temperature, or that of the hottest zone if none is labelled as the processor's."""
        readings = {}
        for zone in sorted(self.sys_root.glob("class/thermal/thermal_zone*")):
            milli_c = _number_in(zone / "temp")
            if milli_c is not None:
                readings[_text_in(zone / "type") or zone.name] = milli_c / 1000
        cpu = [c for name, c in readings.items() if "cpu" in name.lower() or name == "x86_pkg_temp"]
        return max(cpu or readings.values(), default=None)

    def clock_mhz(self) -> float | None:
        """Return the slowest core's clock now; None if the machine does not report it."""
        files = self.sys_root.glob("devices/system/cpu/cpu[0-9]*/cpufreq/scaling_cur_freq")
        return min((khz / 1000 for f in files if (khz := _number_in(f)) is not None), default=None)

    def throttled(self) -> str | None:
        """Return what `vcgencmd get_throttled` reports, such as "0x0"; None if it fails, or is not there."""
        name, _, value = self._ask_firmware("get_throttled").partition("=")
        return value if name == "throttled" and THROTTLED_VALUE.fullmatch(value) else None

    def supply_v(self) -> float | None:
        """Return the volts that a Raspberry Pi 5 measures at its 5 V input; None elsewhere."""
        reported = SUPPLY_VALUE.search(self._ask_firmware("pmic_read_adc", "EXT5V_V"))
        return float(reported[1]) if reported else None

    def _ask_firmware(self, *question: str) -> str:
        """Return what vcgencmd prints, nothing if it fails or is not there."""
        try:
            return subprocess.run([self.vcgencmd, *question], capture_output=True, text=True, timeout=5).stdout.strip()
        except (OSError, subprocess.SubprocessError):
            return ""

    def process_peak_memory_mb(self) -> float | None:
        """Return the largest resident memory that this process has ever had, in MB of 10**6 bytes."""
        for line in (_text_in(self.proc_root / "self/status") or "").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024 / 1e6
        return None

    def core_ticks(self) -> list[tuple[int, int]] | None:
        """Return (busy, total) ticks since the machine started for each core; None if they are not reported."""
        rows = [line.split() for line in (_text_in(self.proc_root / "stat") or "").splitlines()]
        cores = [[int(v) for v in r[1:9]] for r in rows if r and r[0].startswith("cpu") and r[0] != "cpu"]
        return [(sum(c) - c[3] - c[4], sum(c)) for c in cores if len(c) > 4] or None  # 3, 4: idle, waiting for disks

    def reading(self) -> dict[str, Any]:
        return {"temperature_c": self.temperature_c(), "clock_mhz": self.clock_mhz(), "throttled": self.throttled()}


def usable_cores() -> int:
    """Return how many cores this process may run on: fewer than the machine has if its affinity was restricted."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def throttled_means(value: str | None, since_the_start: bool = True) -> list[str] | None:
    """Return the meaning of each bit that is set in Host.throttled()'s value; None if there was no reading.

    since_the_start: also of what was true once, and then with "now" or "since the start".
    """
    if value is None:
        return None
    bits = int(value, 16)
    now = [name for bit, name in THROTTLED_BITS.items() if bits >> bit & 1]
    if not since_the_start:
        return now
    ever = [f"{name} since the start" for bit, name in THROTTLED_BITS.items() if bits >> (bit + 16) & 1]
    return [f"{name} now" for name in now] + ever


def _text_in(path: Path) -> str | None:
    try:
        return path.read_text().strip()
    except (OSError, ValueError):
        return None


def _number_in(path: Path) -> float | None:
    try:
        return float(_text_in(path) or "")
    except ValueError:
        return None


def default_log() -> Path:
    """Return where a drive's flight log goes: into the service's state folder (from systemd), or the user's."""
    home = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    return Path(os.environ.get("STATE_DIRECTORY") or Path(home) / "rover") / "flight.log"


def is_listened_at(place: Path) -> bool:
    """Return whether a process listens at a SOCK_SEQPACKET socket. The socket file of a dead process does not count."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK) as asking:
        return asking.connect_ex(str(place)) in (0, errno.EAGAIN)  # EAGAIN: it has no time to answer


def default_view() -> Path:
    """Return where the user's view listens for drives: beside their flight log."""
    return default_log().with_name("view")
