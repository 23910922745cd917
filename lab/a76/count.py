"""The ruler: instructions that a run's artifacts execute on an emulated Cortex-A76, the core of a Raspberry Pi 5.

    count_run("runs/demo")      # writes runs/demo/arm.json

Emulation says nothing about time, but it counts exactly, on any workstation, and the same again tomorrow. The emulated
machine is an arm64 Debian's Python with the wheels that a Pi gets (requirements_pi.txt), under QEMU's user emulation
with a small plugin of ours (guest/count.c); in it runs rover_lib.onboard alone, in one thread. Nothing of the host
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
import warnings
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
import torch

from lab.debian import fetch_packages, install_packages, missing_packages, unpack_packages
from lab.params import lab_params
from rover_lib.onboard.artifact import content_hash, read_manifest
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.params import params
from rover_lib.onboard.policy import load_policy
from rover_lib.onboard.stage import read_stage, sha256_of, write_stage
from rover_lib.workshop import quantize as q
from rover_lib.workshop.cache import cached_folder, key_of
from rover_lib.workshop.checkpoint import Checkpoint
from rover_lib.workshop.compare import Fidelity, gate, thinned
from rover_lib.workshop.session import opened

REPOSITORY = Path(__file__).parents[2]
PLUGIN = Path(__file__).parent / "guest" / "count.c"
GUEST = Path(__file__).parent / "guest" / "predict.py"
REQUIREMENTS = REPOSITORY / "requirements_pi.txt"

REFERENCE, STATIC = "policy_fp32", "policy_static"
LABEL = "counted on an emulated Cortex-A76"
NEEDS = {  # the Debian packages of commands and files
    "qemu-aarch64": "qemu-user",
    "gcc": "gcc",
    "c++filt": "binutils",
    "/usr/include/stdio.h": "libc6-dev",
}
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
SLOW_GMAC = 1.0  # FP32 of more takes a minute and a half per emulated inference, so that few frames must do
BIT_FRAMES = 4
KERNELS = 30  # named in the report, the rest summed up
SAMPLE_S = 0.2  # the emulator's own memory grows slowly
SILENCE_S = 1200  # of its processor's time: loading the full policy in FP32 takes five minutes without a word
WAITING = 6  # times as long by the clock, on a machine that has more to do

PI5_CORES, PI5_GHZ, SIMD_PER_CYCLE = 4, 2.4, 2
PUBLISHED_GMAC_PER_S = 207  # ResNet18 at 224x224 in INT8, ExecuTorch with XNNPACK, 8.75 ms p50 on a Pi 5
LOOP_PER_SDOT = 80 / 64  # instructions of XNNPACK's inner loop per SDOT, counted here
IPC_SEEN = PUBLISHED_GMAC_PER_S / SDOT_MACS / (PI5_CORES * PI5_GHZ) * LOOP_PER_SDOT
PREDICTED = (
    f"low: SIMD instructions / ({SIMD_PER_CYCLE} per cycle x {PI5_CORES} cores x {PI5_GHZ} GHz); "
    f"high: all instructions / ({IPC_SEEN:.2f} per cycle x {PI5_CORES} cores x {PI5_GHZ} GHz)"
)

SAME_POLICY = 0.01  # of the multiply-accumulates: the instructions' gates are for one policy
# What kernels do, by their names; the first that matches counts.
INT8_SDOT, INT8_OTHER, REST = "INT8 products: SDOT", "INT8 products: all else", "rest"
GROUPS = (
    (
        INT8_OTHER,
        r"with SDOT|xnn_q\w*(gemm|conv)|neondot|q8(gemm|conv)|Mlas\w*(GemmQuant|Gemm[SU]8|QGemm|Qgemm|ConvSym|ConvDw)",
    ),
    ("float products", r"sgemm_(kernel|nn|nt|tn|tt)|sgemv|arm_gemm|xnn_f32\w*(gemm|conv)|Mlas\w*Gemm"),
    ("softmax and exp", r"exp(f|_|\d|minus|on)|[Ss]oftmax|attention"),
    ("LayerNorm", r"[Ll]ayer_?[Nn]orm|RowwiseMoments"),
    ("to and from INT8", r"[Qq]uantize|lrintf|vcvt"),
    ("the frame (OpenCV)", r"^\[cv2"),
    ("copies", r"[Cc]opy|mem(set|move)|im2col|unfold|[Tt]ranspose|indirection|(?<![Nn])[Pp]ack(?!ag)|^\[libc"),
    ("element-wise", r"VectorizedLoop|vectorized_loop|max_?pool|v(add|mul|clamp|max)|(add|mul|relu|clamp)\w*_kernel"),
)

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


def prepare(progress: Progress = None) -> Machine:
    """Everything that counting needs, from the cache or made now (about half a minute).

    Debian packages that are missing are installed when this runs as root. Raises ArmError or DebianError if anything is
    not to be had.
    """
    steps = (_install_missing, _plugin, _userland)
    watched = progress(steps, desc="emulated Cortex-A76", total=len(steps)) if progress else steps
    _, plugin, root = [step() for step in watched]
    return Machine(root, plugin)


def _install_missing() -> None:
    install_packages(missing_packages(NEEDS), "counting")


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
    with tempfile.TemporaryDirectory(dir=root.parent, prefix=".apt.") as scratch:
        unpack_packages(fetch_packages(Path(scratch), GUEST_PACKAGES), root)
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
    """Run an aarch64 program to its end, one core, and read the counts that it marked (see guest/count.c).

    folder: for the counts, and what the program leaves. on_line: told each line on its stdout. stop: ends it when set.
    Raises ArmError with the end of its stderr if it fails, or says nothing for SILENCE_S of its processor's time;
    whatever ends this, the emulator ends with it.
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
            heard, heard_cpu_s = time.monotonic(), 0.0
            while True:
                ready = readable.select(SAMPLE_S)
                if stop and stop.is_set():
                    raise ArmError("stopped, because another count failed")
                peak_mb, outside_mb = _memory_mb(process.pid)
                peak[step] = max(peak[step], peak_mb - outside_mb)
                emulator_mb = outside_mb or emulator_mb
                if not ready:
                    silent_s = max(_cpu_s(process.pid) - heard_cpu_s, (time.monotonic() - heard) / WAITING)
                    if silent_s > SILENCE_S:
                        raise ArmError(
                            f"the emulated program said nothing for {SILENCE_S} s after {step or 'its start'}"
                        )
                    continue
                heard, heard_cpu_s = time.monotonic(), _cpu_s(process.pid)
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
    # setpriv: whoever started it may be killed before it can end its emulator
    return ["setpriv", "--pdeathsig", "KILL", "qemu-aarch64", "-L", str(root), "-cpu", "cortex-a76", *place]


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


def _cpu_s(pid: int) -> float:
    """Processor time that a process has used; 0 if it ended."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


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
    """Executed (instructions, SIMD, SDOT) by function, demangled, most first; what is beyond `at_most` is "other".

    Where a library was stripped of names, its blocks that hold an SDOT stand apart from the rest of it.
    """
    found: dict[str, list[int]] = defaultdict(lambda: [0, 0, 0])
    for block in blocks:
        name = names[int(block["address"])]
        row = found[f"{name} loops with SDOT" if name.startswith("[") and block["sdot"] else name]
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
    return count_guest(machine, GUEST, artifact, samples, counted=counted, on_step=on_step, stop=stop)


def count_guest(
    machine: Machine,
    script: Path,
    artifact: Path | str,
    samples: Sequence[Any],
    *further: Any,
    packages: Path | None = None,
    counted: int = COUNTED,
    on_step: Callable[[], None] = lambda: None,
    stop: Event | None = None,
) -> Counted:
    """`count_artifact` by another script, which is told and leaves what guest/predict.py is told and leaves.

    further: arguments after those. packages: laid before the Pi's own.
    """
    with tempfile.TemporaryDirectory(prefix="rover-arm-") as scratch:
        folder = Path(scratch)
        observations = write_observations(folder / "observations.npz", samples)
        before = ""

        def on_line(line: str) -> None:
            nonlocal before
            if before == "predict":  # a step has ended when the next one begins
                on_step()
            before = line

        arguments = [Path(artifact).resolve(), observations, folder, counted, *further]
        done = emulate_script(machine, script, arguments, folder, packages=packages, on_line=on_line, stop=stop)
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


def emulate_script(
    machine: Machine,
    script: Path,
    arguments: Sequence[Any],
    folder: Path,
    *,
    packages: Path | None = None,
    **options: Any,
) -> Emulation:
    """`emulate` a Python script of ours in the emulated Pi, with rover_lib and what lies beside guest/predict.py.

    packages: laid before the Pi's own. options: of `emulate`.
    """
    environment = _environment(machine.root, folder)
    places = [*([packages] if packages else []), environment["PYTHONPATH"], REPOSITORY, GUEST.parent]
    environment["PYTHONPATH"] = ":".join(map(str, places))
    environment["PYTHONDONTWRITEBYTECODE"] = "1"  # nothing of the emulated Python goes into the checkout
    command = [machine.root / "usr" / "bin" / f"python{PYTHON}", script, *map(str, arguments)]
    return emulate(machine, command, folder, environment=environment, **options)


def count_run(
    run_dir: Path | str, *, frames: int = FRAMES, jobs: int | None = None, progress: Progress = None
) -> dict[str, Any]:
    """Count every artifact of a run, write its arm.json and return what is in it.

    Judged on `frames` of the run's held-out frames: what each artifact predicts in the emulated Pi against what the
    FP32 artifact of its image size predicts on this machine, and the same of this machine's predictions beside it.
    FP32 takes up to minutes per frame there: it predicts a few frames there too, and must give what it gives here, to
    the parity vectors' tolerance. An artifact of an image size without an FP32 is counted only. Of policy_static also
    the bits that its INT8 backbone gives are compared (see `backbone_bits`).
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
    # What takes longest begins first, so that no core waits for it in the end.
    for stem in sorted(artifacts, key=lambda stem: (stem not in references.values(), -manifests[stem]["gmac"])):
        plans[stem] = _plan(stem, references, manifests[stem], samples)
    counts = _count_all(machine, artifacts, plans, jobs or os.cpu_count() or 1, progress)
    found = {stem: artifact_metrics(counted, manifests[stem]) for stem, counted in counts.items()}
    at = {stem: [i for i, s in enumerate(samples) if any(s is p for p in plans[stem][0])] for stem in plans}
    here, differences = {}, {}
    for stem in {r for r in references.values() if r}:
        here[stem] = _chunks_here(artifacts[stem], samples, progress)
        differences[stem] = float(np.abs(counts[stem].chunks - here[stem][at[stem]]).max())
        if not differences[stem] <= params()["parity"]["fp32"]:
            raise ArmError(f"{artifacts[stem]}: differs by {differences[stem]:.2g} on the core; quantize again")
    ranges = again.recordings.action_range()
    for stem, reference in references.items():
        if reference is None:
            continue
        names, expected = manifests[stem]["action_names"], here[reference][at[stem]]
        is_reference = stem == reference
        at_home = expected if is_reference else _chunks_here(artifacts[stem], plans[stem][0], progress)
        found[stem] |= errors_pct(expected, counts[stem].chunks, names, ranges)
        found[stem] |= {f"workstation_{k}": v for k, v in errors_pct(expected, at_home, names, ranges).items()}
        found[stem] |= {"reference": reference, "frames_on_the_core": len(at[stem])}
        found[stem]["reference_max_difference"] = differences[reference]
    metrics: dict[str, Any] = {"label": LABEL, "artifacts": dict(sorted(found.items()))}
    if (run_dir / "load.json").exists() and (note := read_stage(run_dir / "load.json", "load")["metrics"].get("note")):
        metrics["note"] = note
    if STATIC in artifacts:
        few = thinned(samples, BIT_FRAMES)
        metrics["backbone_bits"] = backbone_bits(run_dir, machine, again.checkpoint, few)
    metrics["gates"] = gates(metrics, lab_params()["arm"]["gates"])
    how = {"frames": len(samples), "steady": STEADY, "cpu": "cortex-a76", "threads": 1}
    how["qemu"] = _call(["qemu-aarch64", "--version"], "the emulator does not run").splitlines()[0]
    inputs = {p.name: sha256_of(p) for p in artifacts.values()}
    return write_stage(run_dir / "arm.json", "arm", params=how, metrics=metrics, inputs=inputs)


def reference_of(stem: str, artifacts: Iterable[str]) -> str | None:
    """The FP32 artifact to judge by: policy_static_180x320 by policy_fp32_180x320, or by none if that is not there."""
    size = re.search(r"_\d+x\d+$", stem)
    own = REFERENCE + (size.group() if size else "")
    return own if own in artifacts else None


def _plan(
    stem: str, references: dict[str, str | None], manifest: dict[str, Any], samples: Sequence[Any]
) -> tuple[Sequence[Any], int]:
    """Which samples an artifact predicts in the emulated Pi, and how many inferences are counted one by one."""
    if references[stem] is None or (stem == references[stem] and manifest["gmac"] >= SLOW_GMAC):
        return samples[:STEADY], STEADY
    # FP32 is only held against this machine's, and nobody would drive a Pi with dynamic: both are slow.
    few = stem == references[stem] or manifest["mode"] == "dynamic"
    return (thinned(samples, COUNTED) if few else samples), COUNTED


def _count_all(
    machine: Machine, artifacts: dict[str, Path], plans: dict[str, tuple], jobs: int, progress: Progress
) -> dict[str, Counted]:
    def count(samples: Sequence[Any], counted: int, artifact: Path) -> Callable[..., Counted]:
        return lambda **how: count_artifact(machine, artifact, samples, counted=counted, **how)

    todo = {stem: count(*plan, artifacts[stem]) for stem, plan in plans.items()}
    steps = sum(max(len(samples), counted) for samples, counted in plans.values())
    return side_by_side(todo, steps, "emulated inferences", jobs, progress)


def side_by_side(
    todo: dict[str, Callable[..., Counted]], steps: int, what: str, jobs: int, progress: Progress
) -> dict[str, Counted]:
    """Count several emulated machines, `jobs` at a time: a count does not depend on who else is running.

    todo: called with on_step and stop, see `count_artifact`; the others end when one fails. steps: of all of them
    together; what: they are, for the bar.
    """
    bar = iter(progress(range(steps), desc=what, total=steps) if progress else range(steps))
    one_at_a_time, stop = Lock(), Event()

    def on_step() -> None:
        with one_at_a_time:
            next(bar, None)

    with ThreadPoolExecutor(min(jobs, len(todo))) as pool:
        started = {name: pool.submit(count, on_step=on_step, stop=stop) for name, count in todo.items()}
        try:
            for future in as_completed(started.values()):
                future.result()
        finally:
            stop.set()  # when one failed, or the user does not want to wait
            pool.shutdown(cancel_futures=True)
    next(bar, None)
    return {name: future.result() for name, future in started.items()}


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


def requantized(run_dir: Path | str, checkpoint: Checkpoint, stem: str = STATIC) -> q.QuantizedPolicy:
    """The policy that a run's artifact was exported from, made again from the run's calibration.

    Raises ArmError if the run's files are not those that the artifact was made from.
    """
    run_dir = Path(run_dir)
    stage = read_stage(run_dir / "quantize.json", "quantize")
    made, calibrated = stage["metrics"]["modes"][stem.removeprefix("policy_")], run_dir / "calibration.pt"
    found = content_hash(run_dir / f"{stem}.pt"), sha256_of(calibrated)
    if found != (made["content_hash"], stage["inputs"]["calibration.pt"]):
        raise ArmError(f"{run_dir}: {stem}.pt and calibration.pt are not those of quantize.json; quantize again")
    scheme = q.Scheme(**made["scheme"] | {"float_blocks": tuple(made["scheme"]["float_blocks"])})
    return q.quantize(checkpoint, scheme, q.Calibration.load(calibrated))


def backbone_bits(
    run_dir: Path | str,
    machine: Machine,
    checkpoint: Checkpoint,
    samples: Sequence[Any],
) -> dict[str, int]:
    """Whether policy_static's INT8 backbone gives the same bits in the emulated Pi as on this machine.

    The backbone (up to the image projection's INT8 output) is cut out of the same graph (see `requantized`) and run on
    prepared frames on both. Returns {frames, values, differing}: so many values were compared, so many are not the
    same. Raises ArmError if the run's files are not those that policy_static.pt was made from.
    """
    backbone = q.backbone_of(requantized(run_dir, checkpoint)).eval()
    inputs = [q.inputs_of(s, checkpoint.config) for s in samples]
    with tempfile.TemporaryDirectory(prefix="rover-arm-") as scratch, torch.inference_mode():
        folder = Path(scratch)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of the trace: shapes are constants here, and meant to be
            traced = torch.jit.freeze(torch.jit.trace(backbone, inputs[0], check_trace=False).eval())
        traced.save(folder / "backbone.pt")
        frames = {f"frame_{i:04d}": frame.numpy() for i, (_, frame) in enumerate(inputs)}
        np.savez(folder / "inputs.npz", state=torch.cat([state for state, _ in inputs]).numpy(), **frames)
        with torch.jit.optimized_execution(False):
            here = torch.cat([traced(*x) for x in inputs]).numpy()
        emulate_script(machine, GUEST, ["--backbone", q.ENGINE, "backbone.pt", "inputs.npz"], folder)
        there = np.load(folder / "backbone.npy")
    if (here.dtype, here.shape) != (there.dtype, there.shape):
        raise ArmError(f"the backbone gives {there.dtype} {there.shape} on the core and {here.dtype} {here.shape} here")
    return {"frames": len(here), "values": here.size, "differing": int((there != here).sum())}


def artifact_metrics(counted: Counted, manifest: dict[str, Any]) -> dict[str, Any]:
    """What arm.json says of one artifact; _g are 10**9 instructions. The floor is SDOT alone, for every mode."""
    floor_g = manifest["gmac"] / SDOT_MACS
    inferences_g = [n / 1e9 for n in counted.inferences]
    low_ms, high_ms = predicted_ms(counted.simd / 1e9, counted.steady / 1e9)
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
        "gmac": manifest["gmac"],
        "image_height": manifest["cameras"][0]["height"],
        "image_width": manifest["cameras"][0]["width"],
        "instructions_by_kernel": {name: row[0] / 1e9 for name, row in counted.kernels.items()},
        "simd_by_kernel": {name: row[1] / 1e9 for name, row in counted.kernels.items()},
        "sdot_by_kernel": {name: row[2] / 1e9 for name, row in counted.kernels.items()},
        "peak_memory_mb": counted.peak_mb,
        "peak_memory_loading_mb": counted.peak_loading_mb,
        "emulator_memory_mb": counted.emulator_mb,
        "threads": counted.versions["threads"],
        "versions": counted.versions,
        "computed_pi5_ms": {"low": low_ms, "high": high_ms, "formula": PREDICTED},
    }


# --- reading ----------------------------------------------------------------------------------------------------------


def predicted_ms(simd_g: float, instructions_g: float) -> tuple[float, float]:
    """A range for the time of one inference on a Raspberry Pi 5, in ms, computed from counts. Nothing here was timed.

    low: the SIMD instructions alone at two per cycle, which is what a Cortex-A76 can issue (Arm's optimisation guide),
    on four cores at 2.4 GHz, all of them always busy. No program with this count can be faster.
    high: all instructions at the rate that such kernels have been seen to reach on a Pi 5. Published: ResNet18 at
    224x224 with XNNPACK's INT8 kernels in 8.75 ms, which is 207 GMAC/s, 67 % of the chip's SDOT peak, or 1.35 SDOT per
    cycle and core. Their inner loop executes 80 instructions for 64 SDOT, hence 1.68 instructions per cycle (more, if
    what is outside the loop is counted too).
    Not known, and in neither: how evenly the work divides over four threads, waiting for memory (the published network
    has 11 MB of weights, the full policy 66), and whether float kernels, which are most of FP32's, reach that rate. So
    high is a careful estimate and no bound.
    """
    cycles_per_ms = PI5_CORES * PI5_GHZ * 1e6
    return simd_g * 1e9 / (SIMD_PER_CYCLE * cycles_per_ms), instructions_g * 1e9 / (IPC_SEEN * cycles_per_ms)


def gates(metrics: dict[str, Any], limits: dict[str, Any]) -> list[dict[str, Any]]:
    """What static artifacts must reach, as `compare.gate` rows. metrics: of arm.json; limits: arm.gates of
    lab/params.yml.

    A gate that this run has no artifact for is left out: the instructions are for the user's policy, known by its
    multiply-accumulates. Errors are held against this machine's: as many times, the worse of the actions.
    """
    rows = []
    for stem, found in metrics["artifacts"].items():
        known = limits["policies"].get(stem, {})
        if known and abs(found["gmac"] / known["gmac"] - 1) < SAME_POLICY:
            rows += [gate(f"{stem} {key}", found[key], "<=", known[key]) for key in known if key != "gmac"]
        if not re.fullmatch(rf"{STATIC}(_\d+x\d+)?", stem) or found.get("reference") is None:
            continue
        home = {k.removeprefix("workstation_"): v for k, v in found.items() if k.startswith("workstation_")}
        worse = max(found[k] / at_home if at_home else float("inf") for k, at_home in home.items())
        off_pct = 100 * abs(found["tenth_g"] / found["instructions_g"] - 1)
        rows += [
            gate(f"{stem} error, x workstation's", worse, "<=", limits["x_workstation_error"]),
            gate(f"{stem} frames judged on the core", found["frames_on_the_core"], ">=", limits["frames"]),
            gate(f"{stem} tenth off the third, %", off_pct, "<=", limits["tenth_pct"]),
            gate(f"{stem} peak_memory_mb", found["peak_memory_mb"], "<=", limits["peak_memory_mb"]),
            gate(
                f"{stem} peak_memory_loading_mb",
                found["peak_memory_loading_mb"],
                "<=",
                limits["peak_memory_loading_mb"],
            ),
        ]
    if bits := metrics.get("backbone_bits"):
        rows.append(
            gate(f"{STATIC} backbone values that differ", bits["differing"], "<=", limits["backbone_differing"])
        )
    return rows


def group_kernels(found: dict[str, Any]) -> dict[str, float]:
    """An artifact's or a peer's instructions by what they do, 10**9 each, in a fixed order; the sum is instructions_g.

    found: with instructions_by_kernel and, to part a product's SDOT from what feeds it, sdot_by_kernel.
    """
    groups = dict.fromkeys((INT8_SDOT, *(name for name, _ in GROUPS), REST), 0.0)
    sdot = found.get("sdot_by_kernel", {})
    for kernel, instructions_g in found["instructions_by_kernel"].items():
        group = next((name for name, pattern in GROUPS if re.search(pattern, kernel)), REST)
        products_g = sdot.get(kernel, 0.0) if group == INT8_OTHER else 0.0
        groups[INT8_SDOT] += products_g
        groups[group] += instructions_g - products_g
    return groups


def table(content: dict[str, Any]) -> str:
    """arm.json for people: the counts, fewest instructions first; the computed time by itself; the gates."""
    metrics = content["metrics"]
    counted = metrics["artifacts"] | {n: m for n, m in metrics.get("peers", {}).items() if "artifact" not in m}
    rows = sorted(counted.items(), key=lambda item: item[1]["instructions_g"])
    wide = max(24, *(len(stem) for stem in counted))
    lines = [
        f"{LABEL}, G instructions per inference; errors against FP32 in percent of the recorded range",
        f"{'':{wide}} {'steady':>7} {'SIMD':>7} {'x floor':>7} {'first':>7} {'tenth':>7} {'load':>7}"
        f" {'MB':>6} {'loading':>7} {'steering':>8} {'throttle':>8} {'frames':>6}",
    ]
    columns = ("instructions_g", "simd_g", "x_floor", "first_g", "tenth_g", "load_instructions_g")
    columns += ("peak_memory_mb", "peak_memory_loading_mb", "steering_mae_pct", "throttle_mae_pct")
    columns += ("frames_on_the_core",)
    for stem, m in rows:
        cells = zip(columns, (7, 7, 7, 7, 7, 7, 6, 7, 8, 8, 6), strict=True)
        lines.append(" ".join([f"{stem:{wide}}", *(_cell(m.get(key), key, width) for key, width in cells)]))
    lines += ["", f"computed from these counts for a Raspberry Pi 5, ms, never timed ({PREDICTED})"]
    for stem, m in rows:
        low, high = predicted_ms(m["simd_g"], m["instructions_g"])
        lines.append(f"{stem:{wide}} {low:7.3g} to {high:.3g}")
    if note := metrics.get("note"):
        lines += ["", f"note: {note}"]
    if metrics.get("gates"):
        lines += ["", "gates (lab/params.yml)"]
        for row in metrics["gates"]:
            verdict = {True: "pass", False: "FAIL", None: "not measured"}[row["passed"]]
            shown = "-" if row["found"] is None else f"{row['found']:.4g}"
            lines.append(f"{row['gate']:56} {shown:>8} {row['relation']} {row['limit']:<6g} {verdict}")
    return "\n".join(lines)


def _cell(value: float | None, key: str, width: int) -> str:
    form = ".3f" if key.endswith("_pct") else ".0f" if key.endswith("_mb") else ".2f" if key == "x_floor" else ".4g"
    return f"{'-' if value is None else format(value, form):>{width}}"
