"""The ruler: instructions that a run's artifacts execute on an emulated Cortex-A76, the core of a Raspberry Pi 5.

    count_run("runs/demo")      # writes runs/demo/arm.json

Emulation says nothing about time, but it counts exactly, on any workstation, and the same again tomorrow. The emulated
machine is an arm64 Debian's Python with the wheels that a Pi gets (requirements_pi.txt), under QEMU's user emulation
with a small plugin of ours (emulated/count.c); in it runs rover_lib.onboard alone, in one thread. Nothing of the host
is changed: packages are fetched by a private apt, unpacked without being installed, and cached.

Memory is the most that the emulator's process held resident, as the kernel keeps it, less the emulator's own share: its
translated code and the plugin's counters lie outside the address range that it reserves for the guest at a fixed place,
grow slowly, and are read five times a second. They are reported beside it. MB are 10**6 bytes.
"""

import json
import mmap
import os
import re
import selectors
import shutil
import subprocess
import sys
import tempfile
import time
from bisect import bisect_right
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Event, Lock
from typing import Any

import numpy as np

from rover_lib.onboard.artifact import read_manifest
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.policy import load_policy
from rover_lib.onboard.stage import sha256_of, write_stage
from rover_lib.workshop.cache import cached_folder, key_of
from rover_lib.workshop.compare import Fidelity, thinned
from rover_lib.workshop.params import params
from rover_lib.workshop.session import SMALL_GMAC, opened

REPOSITORY = Path(__file__).parents[2]
PLUGIN = REPOSITORY / "emulated" / "count.c"
GUEST = REPOSITORY / "emulated" / "guest.py"
REQUIREMENTS = REPOSITORY / "requirements_pi.txt"

REFERENCE = "policy_fp32"
LABEL = "counted on an emulated Cortex-A76"
NEEDS = {"qemu-aarch64": "qemu-user", "gcc": "gcc", "c++filt": "binutils"}  # command: its Debian package
HEADERS = {"/usr/include/stdio.h": "libc6-dev"}
RECIPE = 1  # one more when the userland is made in another way: older ones are then not used
GUEST_PACKAGES = ("python3.11", "libgomp1", "libstdc++6")
PYTHON, PLATFORM = "3.11", "aarch64-manylinux_2_28"
CORES = 4  # of the Pi; with fewer or others in /proc/cpuinfo, XNNPACK would choose other kernels
CPUINFO = """processor\t: {core}
BogoMIPS\t: 108.00
Features\t: fp asimd evtstrm aes pmull sha1 sha2 crc32 atomics fphp asimdhp cpuid asimdrdm lrcpc dcpop asimddp
CPU implementer\t: 0x41
CPU architecture: 8
CPU variant\t: 0x4
CPU part\t: 0xd0b
CPU revision\t: 1

"""
GUEST_BASE, GUEST_SIZE = 0x100000000000, 0x4000000000  # the guest's addresses, as the host sees them
SDOT_MACS = 16  # multiply-accumulates of one SDOT: the floor is as if nothing else ran
COUNTED = 10  # inferences after loading, each for itself
STEADY = 3  # the first whose count is what all later ones cost
FRAMES = 50
KERNELS = 30  # named in the report, the rest summed up
SAMPLE_S = 0.2  # the emulator's own memory grows slowly
SILENCE_S = 1200  # one emulated inference of the full policy in FP32 takes about a minute

BLOCK = np.dtype([(n, "<u8") for n in ("address", "entered", "instructions", "simd", "sdot")])  # as in count.c
SECTION = np.dtype("<u4,<u4,<u8,<u8,<u8,<u8,<u4,<u4,<u8,<u8")  # of an ELF file
SYMBOL = np.dtype(
    [("name", "<u4"), ("info", "u1"), ("other", "u1"), ("section", "<u2"), ("at", "<u8"), ("size", "<u8")]
)
SYMTAB, DYNSYM = 2, 11
FUNCTIONS = (0, 2, 10)  # symbol types none (assembly), function, indirect function

Progress = Callable[..., Iterable] | None


class ArmError(RoverError):
    """The emulated Cortex-A76 cannot be set up here, or what ran in it failed."""


# --- preparing --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Machine:
    """An emulated Pi: its file system, the wheels included, and the plugin that counts."""

    root: Path
    plugin: Path


def missing_packages() -> list[str]:
    """Debian packages that counting needs and this machine lacks."""
    commands = {package for command, package in NEEDS.items() if not shutil.which(command)}
    return sorted(commands | {package for file, package in HEADERS.items() if not Path(file).exists()})


def prepare(progress: Progress = None) -> Machine:
    """Everything that counting needs, from the cache or made now (about half a minute).

    Debian packages that are missing are installed when this runs as root. Raises ArmError if anything is not to be had.
    """
    steps = (_install_missing, _plugin, _userland)
    watched = progress(steps, desc="emulated Cortex-A76", total=len(steps)) if progress else steps
    _, plugin, root = [step() for step in watched]
    return Machine(root, plugin)


def _install_missing() -> None:
    missing = missing_packages()
    if not missing:
        return
    command = ["apt-get", "install", "--yes", "--quiet", "--no-install-recommends", *missing]
    if os.geteuid() != 0 or not shutil.which("apt-get"):
        raise ArmError(
            f"counting needs the Debian packages {' '.join(missing)}, which are not here: sudo {' '.join(command)}"
        )
    print(f"installing Debian packages: {' '.join(missing)}", file=sys.stderr)
    _call(["apt-get", "update", "--quiet"], "apt-get cannot read the package lists")
    _call(
        command, f"apt-get cannot install {' '.join(missing)}", env={**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    )


def _call(command: Sequence[Any], what: str, **options: Any) -> str:
    """Run a command and return its stdout; ArmError with the end of what it said if it fails."""
    try:
        done = subprocess.run([str(c) for c in command], capture_output=True, text=True, **options)
    except OSError as e:
        raise ArmError(f"{what}: {e}") from None
    if done.returncode:
        raise ArmError(f"{what}: {_end_of(done.stderr or done.stdout)}")
    return done.stdout


def _end_of(text: str) -> str:
    return " ".join(text.split())[-400:] or "it said nothing"


def _plugin() -> Path:
    def make(folder: Path) -> None:
        # What the emulator provides is resolved when it loads the plugin.
        command = ["gcc", "-O2", "-Wall", "-shared", "-fPIC", "-o", folder / "count.so", PLUGIN]
        _call(command, f"{PLUGIN.name} does not compile")

    return cached_folder("arm-plugin", key_of({}, PLUGIN), make) / "count.so"


def _userland() -> Path:
    recipe = {"made": [GUEST_PACKAGES, PYTHON, PLATFORM, CPUINFO, CORES, RECIPE]}
    return cached_folder("arm-userland", key_of(recipe, REQUIREMENTS), _make_userland)


def _make_userland(root: Path) -> None:
    for tool in ("apt-get", "dpkg"):
        if not shutil.which(tool):
            raise ArmError(f"no {tool} to fetch an arm64 Python with: use Debian 12, in a container if need be")
    with tempfile.TemporaryDirectory(dir=root.parent, prefix=".apt.") as scratch:
        _unpack_packages(root, Path(scratch))
    uv = _uv()
    command = [uv, "pip", "install", "--quiet", "--require-hashes", "--only-binary", ":all:", "--no-deps"]
    command += ["--python-platform", PLATFORM, "--python-version", PYTHON, "--target", _site(root)]
    _call([*command, "--requirement", REQUIREMENTS], f"uv cannot fetch the Pi's wheels of {REQUIREMENTS.name}")
    # QEMU looks for every absolute path below this root first, so these stand before the host's own files.
    (root / "proc").mkdir()
    (root / "proc" / "cpuinfo").write_text("".join(CPUINFO.format(core=i) for i in range(CORES)))
    cpus = root / "sys" / "devices" / "system" / "cpu"
    cpus.mkdir(parents=True)
    for name in ("possible", "present", "online"):
        (cpus / name).write_text(f"0-{CORES - 1}\n")
    # Leaves the bytecode of all that they import, which costs a third of a minute in the emulator, and proves them.
    command = [*_qemu(root), root / "usr" / "bin" / f"python{PYTHON}", "-c", "import torch, cv2, serial"]
    _call(command, "the Pi's wheels do not work in the emulator", env=_environment(root, root))


def _unpack_packages(root: Path, scratch: Path) -> None:
    """arm64 packages by the host's apt sources and keys, with lists, cache and status of its own."""
    for folder in ("lists/partial", "archives/partial"):
        (scratch / folder).mkdir(parents=True)
    (scratch / "status").touch()  # nothing is installed: the dependencies come along
    options = {
        "APT::Architecture": "arm64",
        "APT::Architectures": "arm64",
        "Dir::State": scratch,
        "Dir::State::lists": scratch / "lists",
        "Dir::State::status": scratch / "status",
        "Dir::Cache": scratch,
        "Dir::Cache::archives": scratch / "archives",
        "Dir::Cache::pkgcache": "",
        "Dir::Cache::srcpkgcache": "",
        "Dir::Log": scratch,
        "APT::Sandbox::User": "root",
        "Debug::NoLocking": "true",
    }
    apt = ["apt-get", "--quiet", *(f"--option={key}={value}" for key, value in options.items())]
    _call([*apt, "update"], "apt-get cannot read the arm64 package lists of this machine's sources")
    install = [*apt, "install", "--yes", "--download-only", "--no-install-recommends", *GUEST_PACKAGES]
    _call(install, f"apt-get cannot fetch {' '.join(GUEST_PACKAGES)} for arm64 (Debian 12 has them)")
    for package in sorted((scratch / "archives").glob("*.deb")):
        _call(["dpkg", "--extract", package, root], f"dpkg cannot unpack {package.name}")


def _uv() -> str:
    beside = Path(sys.executable).parent / "uv"
    if found := (str(beside) if beside.is_file() else shutil.which("uv")):
        return found
    raise ArmError("no uv to fetch the Pi's wheels with: pip install uv ('make arm' has it)")


# --- running ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Emulation:
    """What one program did: counts by section, and the most memory that it held by the step that was going on."""

    sections: dict[int, np.ndarray]  # of BLOCK
    peak_mb: dict[str, float]  # by line that the guest had printed last; "" before the first
    emulator_mb: float  # at the end

    def total(self, section: int, what: str = "instructions") -> int:
        """Instructions (or "simd", "sdot") that were executed in a section."""
        blocks = self.sections[section]
        return int((blocks["entered"] * blocks[what]).sum())


def emulate(
    machine: Machine,
    command: Sequence[Path | str],
    folder: Path,
    *,
    environment: dict[str, str] | None = None,
    on_line: Callable[[str], None] | None = None,
    stop: Event | None = None,
) -> Emulation:
    """Run an aarch64 program to its end, one core, and read the counts that it marked (see emulated/count.c).

    folder: for the counts, and what the program leaves. on_line: told each line on its stdout. stop: ends it when set.
    Raises ArmError with the end of its stderr if it fails, or says nothing for SILENCE_S; whatever ends this, the
    emulator ends with it.
    """
    qemu = [*_qemu(machine.root), "-plugin", f"{machine.plugin},folder={folder}", *command]
    peak: dict[str, float] = defaultdict(float)
    step, emulator_mb, unread = "", 0.0, b""
    with (folder / "stderr").open("wb") as stderr, selectors.DefaultSelector() as readable:
        try:
            process = subprocess.Popen(
                [str(c) for c in qemu],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=stderr,
                env=environment or {},
                cwd=folder,
            )
        except OSError as e:
            raise ArmError(f"the emulator does not start: {e}") from None
        try:
            readable.register(process.stdout, selectors.EVENT_READ)
            heard = time.monotonic()
            while True:
                ready = readable.select(SAMPLE_S)
                if stop and stop.is_set():
                    raise ArmError("stopped, because another count failed")
                peak_mb, outside_mb = _memory_mb(process.pid)
                peak[step] = max(peak[step], peak_mb - outside_mb)
                emulator_mb = outside_mb or emulator_mb
                if not ready:
                    if time.monotonic() - heard > SILENCE_S:
                        raise ArmError(
                            f"the emulated program said nothing for {SILENCE_S} s after {step or 'its start'}"
                        )
                    continue
                heard = time.monotonic()
                content = os.read(process.stdout.fileno(), 65536)
                if not content:
                    break
                *lines, unread = (unread + content).split(b"\n")
                for line in lines:
                    before, step = step, line.decode(errors="replace")
                    if step != before:
                        _forget_peak(process.pid)
                    if on_line:
                        on_line(step)
            code = process.wait()
        finally:
            process.kill()
            process.wait()
            process.stdout.close()
    if code:
        said = _end_of((folder / "stderr").read_text(errors="replace"))
        raise ArmError(f"the emulated program ended with {code} after {step or 'its start'}: {said}")
    sections = {int(f.stem): np.fromfile(f, BLOCK) for f in folder.glob("*.blocks")}
    return Emulation(sections, dict(peak), emulator_mb)


def _qemu(root: Path) -> list[str]:
    place = ["-B", hex(GUEST_BASE), "-R", hex(GUEST_SIZE)]
    return ["qemu-aarch64", "-L", str(root), "-cpu", "cortex-a76", *place]


def _environment(root: Path, home: Path) -> dict[str, str]:
    """Of an emulated Python: nothing of the host's, one thread."""
    return {
        "PATH": "/usr/bin",
        "LANG": "C.UTF-8",
        "HOME": str(home),
        "TMPDIR": str(home),
        "PYTHONHOME": str(root / "usr"),
        "PYTHONPATH": str(_site(root)),
        "PYTHONHASHSEED": "0",  # the same order in every dict, the same count
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
    }


def _site(root: Path) -> Path:
    return root / "opt" / "site"


def _memory_mb(pid: int) -> tuple[float, float]:
    """The most that a process held resident, and what it holds now outside the guest's addresses; zeros if it ended."""
    outside_kb, in_guest = 0, False
    try:
        mappings = Path(f"/proc/{pid}/smaps").read_text()
        peak = re.search(r"^VmHWM:\s+(\d+) kB", Path(f"/proc/{pid}/status").read_text(), re.M)
    except OSError:
        return 0.0, 0.0
    for line in mappings.splitlines():
        if line.startswith("Rss:"):
            outside_kb += 0 if in_guest else int(line.split()[1])
        elif not line[0].isupper():  # a mapping's addresses; the lines about it start in capitals
            in_guest = GUEST_BASE <= int(line.partition("-")[0], 16) < GUEST_BASE + GUEST_SIZE
    return (int(peak[1]) * 1024 / 1e6, outside_kb * 1024 / 1e6) if peak else (0.0, 0.0)


def _forget_peak(pid: int) -> None:
    with suppress(OSError):  # ended, or a kernel without it: then a peak of before counts too, and none is missed
        Path(f"/proc/{pid}/clear_refs").write_text("5")


# --- naming -----------------------------------------------------------------------------------------------------------


class Binary:
    """Functions of an ELF file, by address."""

    def __init__(self, path: Path):
        self.path = path
        with path.open("rb") as f, mmap.mmap(f.fileno(), 0, access=mmap.ACCESS_READ) as content:
            if content[:5] != b"\x7fELF\x02":
                raise ArmError(f"{path}: not a 64-bit ELF file, found {content[:5]!r}")
            self.base = self._lowest(content)
            self._read_symbols(content)

    @staticmethod
    def _lowest(content: mmap.mmap) -> int:
        """Address of the first loaded segment, by which a mapping tells where the file was put."""
        offset = int.from_bytes(content[0x20:0x28], "little")
        count = int.from_bytes(content[0x38:0x3A], "little")
        headers = np.frombuffer(content[offset : offset + 56 * count], "<u4,<u4,<u8,<u8,<u8,<u8,<u8,<u8")
        loaded = headers["f3"][headers["f0"] == 1]
        return int(loaded.min()) & ~0xFFF if len(loaded) else 0

    def _read_symbols(self, content: mmap.mmap) -> None:
        offset = int.from_bytes(content[0x28:0x30], "little")
        count = int.from_bytes(content[0x3C:0x3E], "little")
        sections = np.frombuffer(content[offset : offset + 64 * count], SECTION)
        kinds = sections["f1"].tolist()
        self.complete = SYMTAB in kinds  # a stripped file names only what it exports
        symbols, self._names = np.zeros(0, SYMBOL), b""
        if self.complete or DYNSYM in kinds:
            table = sections[kinds.index(SYMTAB if self.complete else DYNSYM)]
            names = sections[int(table["f6"])]
            symbols = np.frombuffer(content[int(table["f4"]) : int(table["f4"] + table["f5"])], SYMBOL)
            self._names = content[int(names["f4"]) : int(names["f4"] + names["f5"])]
        symbols = symbols[np.isin(symbols["info"] & 15, FUNCTIONS) & (symbols["section"] > 0) & (symbols["at"] > 0)]
        # Mapping symbols ($x, $d) mark code and data, they name nothing.
        first = np.frombuffer(self._names, "u1")[symbols["name"]] if len(symbols) else np.zeros(0, "u1")
        symbols = symbols[(first != ord("$")) & (first != 0)]
        self._symbols = symbols[np.lexsort((symbols["size"], symbols["at"]))]
        self._at = self._symbols["at"].tolist()

    def function_at(self, address: int) -> str:
        """Mangled name of the function at an address of the file; the file's name where it names none."""
        i = bisect_right(self._at, address) - 1
        if i >= 0:
            symbol = self._symbols[i]
            if self.complete or address < int(symbol["at"]) + int(symbol["size"]):
                start = int(symbol["name"])
                return self._names[start : self._names.index(b"\0", start)].decode(errors="replace")
        return f"[{self.path.name}]"


class Names:
    """From the addresses of a guest to function names. maps: /proc/self/maps as the guest sees it."""

    def __init__(self, maps: str):
        rows = [line.split(None, 5) for line in maps.splitlines()]
        self._ranges = []
        lowest: dict[str, int] = {}
        for row in rows:
            start, end = (int(v, 16) for v in row[0].split("-"))
            path = row[5].strip() if len(row) > 5 else ""
            lowest[path] = min(lowest.get(path, start), start)
            self._ranges.append((start, end, path))
        self._ranges.sort()
        self._starts = [r[0] for r in self._ranges]
        self._lowest = lowest
        self._binaries: dict[str, Binary] = {}

    def __getitem__(self, address: int) -> str:
        i = bisect_right(self._starts, address) - 1
        _, end, path = self._ranges[i] if i >= 0 else (0, 0, "")
        if address >= end or not path.startswith("/"):
            return "[unknown]"
        if path not in self._binaries:
            self._binaries[path] = Binary(Path(path))
        binary = self._binaries[path]
        return binary.function_at(address - self._lowest[path] + binary.base)


def by_kernel(blocks: np.ndarray, names: Names, at_most: int = KERNELS) -> dict[str, tuple[int, int, int]]:
    """Executed (instructions, SIMD, SDOT) by function, demangled, most first; what is beyond `at_most` is "other"."""
    found: dict[str, list[int]] = defaultdict(lambda: [0, 0, 0])
    for block in blocks:
        row = found[names[int(block["address"])]]
        for i, what in enumerate(("instructions", "simd", "sdot")):
            row[i] += int(block["entered"]) * int(block[what])
    mangled = sorted(found, key=lambda n: -found[n][0])
    plain = _call(["c++filt", "--no-params"], "c++filt does not run", input="\n".join(mangled)).splitlines()
    merged: dict[str, list[int]] = {}
    for i, (name, short) in enumerate(zip(mangled, plain, strict=True)):
        key = _short(short) if i < at_most else "other"
        merged[key] = [a + b for a, b in zip(merged.get(key, (0, 0, 0)), found[name], strict=True)]
    return {name: tuple(row) for name, row in merged.items()}


def _short(name: str, at_most: int = 140) -> str:
    """A C++ name without the wrapper that torch's element-wise loops are called through."""
    name = re.sub(r"^c10::function_ref<.*?>::callback_fn<", "", name)
    return name if len(name) <= at_most else name[: at_most - 3] + "..."


# --- counting ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Counted:
    """An artifact in the emulated Pi. inferences[0] is the first after loading; chunks (n, C, A) float32."""

    load: int  # instructions of load_policy: integrity, unpacking, parity vectors
    inferences: tuple[int, ...]
    simd: int  # of the steady inference, as is sdot
    sdot: int
    kernels: dict[str, tuple[int, int, int]]
    peak_mb: float
    peak_loading_mb: float
    emulator_mb: float
    chunks: np.ndarray
    versions: dict[str, Any]

    @property
    def steady(self) -> int:
        """Instructions of the STEADY-th inference."""
        return self.inferences[STEADY - 1]


def write_observations(path: Path, samples: Sequence[Any]) -> Path:
    """What a policy shall see, where the guest can read it: `state` (n, S) float32, `frame_0000`... (h, w, 3) BGR."""
    frames = {f"frame_{i:04d}": s.frame_bgr() for i, s in enumerate(samples)}
    np.savez(path, state=np.stack([s.state for s in samples]).astype(np.float32), **frames)
    return path


def count_artifact(
    machine: Machine,
    artifact: Path | str,
    samples: Sequence[Any],
    *,
    counted: int = COUNTED,
    on_step: Callable[[], None] = lambda: None,
    stop: Event | None = None,
) -> Counted:
    """Load an artifact in the emulated Pi, predict each sample, and count the first `counted` inferences one by one.

    samples: with frame_bgr() and state; the first ones come again if there are fewer than `counted`, which is at
    least STEADY. on_step: told after each inference. Raises ArmError with what the guest said, if it fails there.
    """
    artifact = Path(artifact).resolve()
    with tempfile.TemporaryDirectory(prefix="rover-arm-") as scratch:
        folder = Path(scratch)
        environment = _environment(machine.root, folder)
        environment["PYTHONPATH"] += f":{REPOSITORY}"
        environment["PYTHONDONTWRITEBYTECODE"] = "1"  # nothing of the emulated Python goes into the checkout
        command = [machine.root / "usr" / "bin" / f"python{PYTHON}", GUEST, artifact]
        command += [write_observations(folder / "observations.npz", samples), folder, str(counted)]
        before = ""

        def on_line(line: str) -> None:
            nonlocal before
            if before == "predict":  # a step has ended when the next one begins
                on_step()
            before = line

        done = emulate(machine, command, folder, environment=environment, on_line=on_line, stop=stop)
        return Counted(
            load=done.total(0),
            inferences=tuple(done.total(i) for i in range(1, counted + 1)),
            simd=done.total(STEADY, "simd"),
            sdot=done.total(STEADY, "sdot"),
            kernels=by_kernel(done.sections[STEADY], Names((folder / "maps").read_text())),
            peak_mb=done.peak_mb["predict"],
            peak_loading_mb=done.peak_mb["load"],
            emulator_mb=done.emulator_mb,
            chunks=np.load(folder / "chunks.npy"),
            versions=json.loads((folder / "versions.json").read_text()),
        )


def count_run(
    run_dir: Path | str, *, frames: int = FRAMES, jobs: int | None = None, progress: Progress = None
) -> dict[str, Any]:
    """Count every artifact of a run, write its arm.json and return what is in it.

    Judged on `frames` of the run's held-out frames: each artifact's error against the FP32 artifact of its size, both
    computed in the emulated Pi, and the same of this machine beside it. FP32 of a large policy takes minutes per frame
    there: it is then computed there on a few frames, held against this machine's, and this machine's is the reference.
    jobs: artifacts at a time, each in one thread and below 1 GB; the machine's cores if None. Raises ArmError, or what
    reading the run raises.
    """
    run_dir = Path(run_dir)
    artifacts = {p.stem: p for p in sorted(run_dir.glob("policy_*.pt"))}
    if REFERENCE not in artifacts:
        raise ArmError(f"{run_dir}: no {REFERENCE}.pt in it (found {sorted(artifacts)}); 'rover run' makes a run")
    manifests = {stem: read_manifest(path) for stem, path in artifacts.items()}
    references = {stem: reference_of(stem, artifacts) for stem in artifacts}
    again = opened(run_dir)
    samples = thinned(again.parts.held_out, frames)
    if not samples:
        raise ArmError(f"{run_dir}: its recordings have no held-out frames to judge with; record more episodes")
    machine = prepare(progress)
    plans = {}
    for stem, manifest in manifests.items():
        slow = stem in references.values() and manifest["gmac"] >= SMALL_GMAC
        plans[stem] = (samples[:STEADY], STEADY) if slow else (samples, COUNTED)
    counts = _count_all(machine, artifacts, plans, jobs or os.cpu_count() or 1, progress)
    here = {stem: _chunks_here(path, samples, progress) for stem, path in artifacts.items()}
    there = {stem: c.chunks for stem, c in counts.items()}
    differences = {}
    for stem in set(references.values()):
        both = len(there[stem])
        differences[stem] = float(np.abs(there[stem] - here[stem][:both]).max())
        if both < len(samples):
            if not differences[stem] <= params()["parity"]["fp32"]:
                raise ArmError(f"{artifacts[stem]}: differs by {differences[stem]:.2g} on the core; quantize again")
            there[stem] = here[stem]
    ranges = again.recordings.action_range()
    found = {}
    for stem, counted in counts.items():
        names, reference = manifests[stem]["action_names"], references[stem]
        errors = errors_pct(there[reference], there[stem], names, ranges)
        at_home = errors_pct(here[reference], here[stem], names, ranges)
        found[stem] = artifact_metrics(counted, manifests[stem]) | errors
        found[stem] |= {f"workstation_{key}": value for key, value in at_home.items()}
        found[stem] |= {"reference": reference, "frames": len(samples), "frames_on_the_core": len(counted.chunks)}
        found[stem]["reference_max_difference"] = differences[reference]
    how = {"frames": len(samples), "steady": STEADY, "cpu": "cortex-a76", "threads": 1}
    how["qemu"] = _call(["qemu-aarch64", "--version"], "the emulator does not run").splitlines()[0]
    inputs = {p.name: sha256_of(p) for p in artifacts.values()}
    metrics = {"label": LABEL, "artifacts": found}
    return write_stage(run_dir / "arm.json", "arm", params=how, metrics=metrics, inputs=inputs)


def reference_of(stem: str, artifacts: Iterable[str]) -> str:
    """The FP32 artifact to judge by: policy_static_180x320 by policy_fp32_180x320 if there is one, or policy_fp32."""
    size = re.search(r"_\d+x\d+$", stem)
    own = REFERENCE + (size.group() if size else "")
    return own if own in artifacts else REFERENCE


def _count_all(
    machine: Machine, artifacts: dict[str, Path], plans: dict[str, tuple], jobs: int, progress: Progress
) -> dict[str, Counted]:
    """Several emulated machines side by side: a count does not depend on who else is running."""
    steps = sum(max(len(samples), counted) for samples, counted in plans.values())
    bar = iter(progress(range(steps), desc="emulated inferences", total=steps) if progress else range(steps))
    one_at_a_time, stop = Lock(), Event()

    def on_step() -> None:
        with one_at_a_time:
            next(bar, None)

    def count(stem: str) -> Counted:
        samples, counted = plans[stem]
        return count_artifact(machine, artifacts[stem], samples, counted=counted, on_step=on_step, stop=stop)

    with ThreadPoolExecutor(min(jobs, len(plans))) as pool:
        started = {stem: pool.submit(count, stem) for stem in plans}
        try:
            for future in as_completed(started.values()):
                future.result()
        finally:
            stop.set()  # when one failed, or the user does not want to wait
            pool.shutdown(cancel_futures=True)
    next(bar, None)
    return {stem: future.result() for stem, future in started.items()}


def _chunks_here(path: Path, samples: Sequence[Any], progress: Progress) -> np.ndarray:
    policy = load_policy(path, threads=1)
    watched = progress(samples, desc=f"{path.stem} on this machine", total=len(samples)) if progress else samples
    return np.stack([policy.predict_chunk(s.frame_bgr(), s.state) for s in watched])


def errors_pct(
    reference: np.ndarray, chunks: np.ndarray, actions: Sequence[str], ranges: dict[str, tuple[float, float]]
) -> dict[str, float]:
    """<action>_mae_pct: mean difference of two sets of chunks (n, C, A), in percent of the recorded range."""
    pad = np.zeros(reference.shape[:2], bool)
    report = Fidelity(tuple(actions), ranges, (), reference, {"arm": chunks}, None, pad)
    mean = report.errors("arm").mean((0, 1))
    return {f"{action}_mae_pct": float(mean[i] * report.pct(action)) for i, action in enumerate(actions)}


def artifact_metrics(counted: Counted, manifest: dict[str, Any]) -> dict[str, Any]:
    """What arm.json says of one artifact; _g are 10**9 instructions. The floor is SDOT alone, for every mode."""
    floor_g = manifest["gmac"] / SDOT_MACS
    inferences_g = [n / 1e9 for n in counted.inferences]
    return {
        "instructions_g": counted.steady / 1e9,
        "simd_g": counted.simd / 1e9,
        "sdot_g": counted.sdot / 1e9,
        "floor_g": floor_g,
        "x_floor": counted.steady / 1e9 / floor_g,
        "first_g": inferences_g[0],
        "second_g": inferences_g[1],
        "tenth_g": inferences_g[9] if len(inferences_g) >= 10 else None,
        "load_instructions_g": counted.load / 1e9,
        "instructions_by_kernel": {name: row[0] / 1e9 for name, row in counted.kernels.items()},
        "simd_by_kernel": {name: row[1] / 1e9 for name, row in counted.kernels.items()},
        "sdot_by_kernel": {name: row[2] / 1e9 for name, row in counted.kernels.items()},
        "peak_memory_mb": counted.peak_mb,
        "peak_memory_loading_mb": counted.peak_loading_mb,
        "emulator_memory_mb": counted.emulator_mb,
        "threads": counted.versions["threads"],
        "versions": counted.versions,
    }


def table(content: dict[str, Any]) -> str:
    """arm.json for people: one line per artifact, fewest instructions first."""
    lines = [
        f"{LABEL}, G instructions per inference; errors against FP32 in percent of the recorded range",
        f"{'':24} {'steady':>7} {'SIMD':>7} {'x floor':>7} {'first':>7} {'tenth':>7} {'load':>7}"
        f" {'MB':>6} {'loading':>7} {'steering':>8} {'throttle':>8}",
    ]
    found = content["metrics"]["artifacts"]
    for stem, m in sorted(found.items(), key=lambda item: item[1]["instructions_g"]):
        tenth = "-" if m["tenth_g"] is None else f"{m['tenth_g']:.4g}"
        errors = [f"{m[k]:8.3f}" for k in ("steering_mae_pct", "throttle_mae_pct") if m.get(k) is not None]
        lines.append(
            f"{stem:24} {m['instructions_g']:7.4g} {m['simd_g']:7.4g} {m['x_floor']:7.2f}"
            f" {m['first_g']:7.4g} {tenth:>7} {m['load_instructions_g']:7.4g}"
            f" {m['peak_memory_mb']:6.0f} {m['peak_memory_loading_mb']:7.0f} {' '.join(errors)}"
        )
    return "\n".join(lines)
