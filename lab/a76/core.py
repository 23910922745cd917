"""Count what a program executes on an emulated Cortex-A76, the core of a Raspberry Pi 5.

    core = prepare()
    emulation = emulate(core, [core.root / "bin/true"], folder)
    emulation.total(section=0)

An arm64 Debian's Python runs with the wheels that a Pi gets (requirements_pi.txt), under QEMU's user emulation with a
plugin of ours (guest/count.c). A peak of memory is the most that the emulator's process held resident, as the kernel
records it, minus its translated code and the plugin's counters, which lie outside the guest's addresses.
"""

import re
import select
import subprocess
import sys
from collections import defaultdict
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lab.debian import install_packages, make_arm64, missing_packages
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.policy.confine import AS_ROOT
from rover_lib.workshop.cache import cache_folder, key_of
from rover_lib.workshop.run_program import last_words, run

REPOSITORY = Path(__file__).parents[2]
GUEST = Path(__file__).parent / "guest"
PLUGIN = GUEST / "count.c"
REQUIREMENTS = REPOSITORY / "requirements_pi.txt"

NEEDS = {  # commands and files, each with the Debian package that it comes from
    "qemu-aarch64": "qemu-user",
    "mmdebstrap": "mmdebstrap",
    "gcc": "gcc",
    "c++filt": "binutils",
    "/usr/include/stdio.h": "libc6-dev",
}
RECIPE = 2  # raise it when the userland is made in another way, so that older ones are not used
GUEST_PACKAGES = ("python3.11", "libgomp1", "libstdc++6")
PYTHON, PLATFORM = "3.11", "aarch64-manylinux_2_28"
INTERPRETER, SITE = f"usr/bin/python{PYTHON}", "opt/site"  # in the emulated Pi
FOR_GUEST = ("--python-platform", PLATFORM, "--python-version", PYTHON)  # options for `fetch_wheels`
CORES = 4  # as on the Pi: with fewer cores or others in /proc/cpuinfo, XNNPACK would choose other kernels
CPUINFO = """processor\t: {core}
BogoMIPS\t: 108.00
Features\t: fp asimd evtstrm aes pmull sha1 sha2 crc32 atomics fphp asimdhp cpuid asimdrdm lrcpc dcpop asimddp
CPU implementer\t: 0x41
CPU architecture: 8
CPU variant\t: 0x4
CPU part\t: 0xd0b
CPU revision\t: 1

"""
A76 = "cortex-a76"  # QEMU's name for the core of a Raspberry Pi 5
GUEST_BASE, GUEST_SIZE = 0x100000000000, 0x4000000000  # the guest's addresses, as the host sees them
SAMPLE_S = 0.2  # often enough, as the emulator's own memory grows slowly

# As in count.c.
BLOCK = np.dtype([(n, "<u8") for n in ("address", "entered", "instructions", "simd", "sdot", "quarters")])


@dataclass(frozen=True)
class Core:
    """An emulated core: its file system with the Pi's wheels, and the plugin that counts."""

    root: Path
    plugin: Path


def prepare() -> Core:
    """Return what counting needs, from the cache or made now, in half a minute.

    Raises RoverError if it cannot be had, as for missing Debian packages, unless INSTALL is set (lab.debian).
    """
    install_packages(missing_packages(NEEDS), "counting")
    recipe = {"made": [GUEST_PACKAGES, PYTHON, PLATFORM, CPUINFO, CORES, RECIPE]}
    root = cache_folder("arm-userland", key_of(recipe, REQUIREMENTS), _make_userland)
    return Core(root, build_plugin())


def build_plugin() -> Path:
    """Return the plugin that counts, from the cache or compiled now."""

    def make(folder: Path) -> None:
        # The emulator's functions need no library here: they are resolved when it loads the plugin.
        run("gcc", "-O3", "-Wall", "-shared", "-fPIC", "-o", folder / "count.so", PLUGIN, error=RoverError)

    return cache_folder("arm-plugin", key_of({}, PLUGIN), make) / "count.so"


def _make_userland(root: Path) -> None:
    make_arm64(root, GUEST_PACKAGES, "--mode=chrootless", "--variant=extract")
    fetch_wheels(root / SITE, REQUIREMENTS)
    # QEMU looks for every absolute path below this root first, so these stand before the host's own files.
    (root / "proc").mkdir()
    (root / "proc" / "cpuinfo").write_text("".join(CPUINFO.format(core=i) for i in range(CORES)))
    cpus = root / "sys" / "devices" / "system" / "cpu"
    cpus.mkdir(parents=True)
    for name in ("possible", "present", "online"):
        (cpus / name).write_text(f"0-{CORES - 1}\n")
    # This proves that the packages work, and leaves the bytecode of everything that they import. To compile that takes
    # a third of a minute in the emulator.
    imports = [root / INTERPRETER, "-c", "import torch, cv2, serial"]
    run(*_qemu(root), *imports, error=RoverError, env=_environment(root, root))


def fetch_wheels(folder: Path, requirements: Path) -> None:
    """Fetch the guest's Python packages into a folder with uv, without installing them. Raises RoverError."""
    local = Path(sys.executable).with_name("uv")
    uv = local if local.is_file() else "uv"
    options = ["--quiet", "--only-binary", ":all:", "--no-deps", "--require-hashes", *FOR_GUEST, "--target", folder]
    remedy = f"pip install uv, and have the index within reach that has {requirements.name}"
    run(uv, "pip", "install", *options, "--requirement", requirements, error=RoverError, remedy=remedy)


def _qemu(root: Path) -> list[str]:
    place = ["-B", hex(GUEST_BASE), "-R", hex(GUEST_SIZE)]
    # setpriv ends the emulator if the process that started it is killed and cannot do so itself.
    return ["setpriv", "--pdeathsig", "KILL", "qemu-aarch64", "-L", str(root), "-cpu", A76, *place]


def _environment(root: Path, home: Path) -> dict[str, str]:
    """Return the environment of an emulated Python, which has nothing from the host's and uses one thread."""
    return {
        "PATH": "/usr/bin",
        "LANG": "C.UTF-8",
        "HOME": str(home),
        "TMPDIR": str(home),
        "PYTHONHOME": str(root / "usr"),
        "PYTHONPATH": str(root / SITE),
        "PYTHONHASHSEED": "0",  # the same hashes every time, so that the count is the same
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        AS_ROOT: "1",  # allowed, as the program is emulated and loads only artifacts that were made here
    }


@dataclass(frozen=True, eq=False)
class Emulation:
    """What one program did: its counts by section, and the most memory that it held in each of its steps."""

    sections: dict[int, np.ndarray]  # arrays of BLOCK
    more: dict[int, np.ndarray]  # by section, if it was watched, as guest/count.c leaves it
    peak_mb: dict[str, float]  # by the line that the program had printed last; "" stands for before the first

    def total(self, section: int, what: str = "instructions") -> int:
        """Return how many instructions, or "simd" or "sdot" ones, were executed in a section."""
        blocks = self.sections[section]
        return int((blocks["entered"] * blocks[what]).sum())

    def cycles(self, section: int) -> float:
        """Return the cycles that a section takes a Cortex-A76 that waits for nothing: `quarters_of` in count.c."""
        return self.total(section, "quarters") / 4

    def lines(self, section: int) -> tuple[int, int]:
        """Return how many lines of 64 bytes the loads of a section had to fetch into its core's first cache (near).

        And how many the shared memory had to deliver, or twice if stores missed each cache (far).
        """
        more = self.more[section]
        return int(more[0]), int(more[4] + 2 * more[3])


def emulate_artifact(core: Core, given: Sequence[object], folder: Path, packages: Path | None, watch: str) -> Emulation:
    """`emulate` guest/predict.py with what it is `given`, the Pi's wheels and rover_lib.

    packages: a folder of packages that come before the Pi's own on the path.
    """
    environment = _environment(core.root, folder)
    places = [*([packages] if packages else []), environment["PYTHONPATH"], REPOSITORY]
    environment["PYTHONPATH"] = ":".join(map(str, places))
    environment["PYTHONDONTWRITEBYTECODE"] = "1"  # keep the emulated Python's bytecode out of the checkout
    command = [core.root / INTERPRETER, GUEST / "predict.py", *given]
    return emulate(core, command, folder, environment=environment, watch=watch)


def emulate(
    core: Core, command: Sequence[object], folder: Path, *, environment: dict[str, str] | None = None, watch: str = ""
) -> Emulation:
    """Run an aarch64 program to its end on one core, and read the counts that it marked (see guest/count.c).

    folder: takes the counts, and what the program leaves. watch: "memory=SECTION", see guest/count.c. Raises RoverError
    with the end of its stderr if it fails. Whatever ends this function also ends the emulator.
    """
    plugin = ",".join([str(core.plugin), f"folder={folder}", *([watch] if watch else [])])
    qemu = [str(word) for word in (*_qemu(core.root), "-plugin", plugin, *command)]
    with (folder / "stderr").open("wb") as stderr:
        talks: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": stderr}
        process = subprocess.Popen(qemu, env=environment or {}, cwd=folder, bufsize=0, **talks)
    assert process.stdout  # a pipe, of which nothing is read ahead
    memory, line = _Memory(process.pid), b"?"
    try:
        while line:
            if not select.select([process.stdout], [], [], SAMPLE_S)[0]:
                memory.sample()
            elif line := process.stdout.readline():
                memory.begin(line.decode(errors="replace").rstrip("\n"))
        code = process.wait()
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
    if code:
        end = last_words((folder / "stderr").read_text(errors="replace"))
        raise RoverError(f"the emulated program ended with {code} after {memory.step or 'its start'}: {end}")
    sections = {int(f.stem): np.fromfile(f, BLOCK) for f in folder.glob("*.blocks")}
    more = {int(f.stem): np.fromfile(f, "<u8") for f in folder.glob("*.more")}
    return Emulation(sections, more, dict(memory.peak_mb))


class _Memory:
    """The most memory that a running emulator held in each step. Each line that it prints begins a step."""

    def __init__(self, pid: int):
        self.pid, self.step = pid, ""
        self.peak_mb: dict[str, float] = defaultdict(float)

    def sample(self) -> None:
        peak_mb, outside_mb = _memory_mb(self.pid)
        self.peak_mb[self.step] = max(self.peak_mb[self.step], peak_mb - outside_mb)

    def begin(self, step: str) -> None:
        self.sample()
        if step != self.step:
            with suppress(OSError):  # if it has ended, or the kernel cannot forget, earlier peaks count too
                Path(f"/proc/{self.pid}/clear_refs").write_text("5")
        self.step = step


def _memory_mb(pid: int) -> tuple[float, float]:
    """Return the most that a process held resident, and what it holds outside the guest's addresses now.

    Both in MB, and zero if it has ended. psutil knows neither the kernel's own peak (VmHWM) nor how to reset it.
    """
    outside_kb, in_guest = 0, False
    try:
        mappings = Path(f"/proc/{pid}/smaps").read_text()
        peak = re.search(r"^VmHWM:\s+(\d+) kB", Path(f"/proc/{pid}/status").read_text(), re.M)
    except OSError:
        return 0.0, 0.0
    for line in mappings.splitlines():
        if line.startswith("Rss:"):
            outside_kb += 0 if in_guest else int(line.split()[1])
        elif not line[0].isupper():  # a mapping's addresses; the lines about it start with capitals
            in_guest = GUEST_BASE <= int(line.partition("-")[0], 16) < GUEST_BASE + GUEST_SIZE
    return (int(peak[1]) * 1024 / 1e6, outside_kb * 1024 / 1e6) if peak else (0.0, 0.0)
