"""Counting against what is known: a program whose instructions can be counted by hand, and itself."""

import struct
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from lab.a76 import core as a76
from lab.a76 import count as counting
from lab.a76 import pi5
from lab.a76 import report as reports
from lab.a76.core import BLOCK, Core, emulate, prepare
from lab.a76.count import STEADY, Counted, count_run
from lab.a76.symbols import by_kernel
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.stage import read_stage
from rover_lib.workshop.act import ACT
from rover_lib.workshop.int8 import quantize as q
from rover_lib.workshop.int8.export import Exporter
from rover_lib.workshop.progress import silent
from tests.helpers import needs
from tests.helpers.policies import memory_samples

pytestmark = [pytest.mark.emulated, needs.qemu]

# Of the thin policy, in 1e6 instructions on an emulated Cortex-A76, and by which share a count may leave it. ONNX
# Runtime's depends on the machine that emulates: 11.81 on one, 12.06 on another, each time the same.
BUDGETS_M = {"policy_static": (10.8, 0.02), "policy_static.onnx": (11.9, 0.03)}
SVC = 0xD4000001
START, ROUNDS, SECTION = 0x400000, 1000, 7


def mov(register: int, value: int) -> list[int]:
    """movz, and movk for the upper half of 32 bits if there is one."""
    low, high = value & 0xFFFF, value >> 16
    return [0xD2800000 | low << 5 | register] + ([0xF2A00000 | high << 5 | register] if high else [])


def mark(starts: int) -> list[int]:
    return [*mov(8, 173), *mov(0, 0xC0FFEE), *mov(1, starts), *mov(2, SECTION), SVC]


LOOP = [
    0x4E829420,  # sdot v0.4s, v1.16b, v2.16b
    0x4EA38463,  # add v3.4s, v3.4s, v3.4s
    0xF1000529,  # subs x9, x9, #1
    0x54000001 | (-3 & 0x7FFFF) << 5,  # b.ne to the sdot
]


def program(path: Path, code: list[int]) -> Path:
    """A static aarch64 ELF file of one segment."""
    words = struct.pack(f"<{len(code)}I", *code)
    size = 64 + 56 + len(words)
    header = struct.pack(
        "<16sHHIQQQIHHHHHH", b"\x7fELF\x02\x01\x01", 2, 183, 1, START + 120, 64, 0, 0, 64, 56, 1, 64, 0, 0
    )
    path.write_bytes(header + struct.pack("<IIQQQQQQ", 1, 5, 0, START, START, size, size, 4096) + words)
    path.chmod(0o755)
    return path


@pytest.fixture(scope="module")
def plugin_only(users_cache, tmp_path_factory) -> Core:
    """Enough for a static program: no userland."""
    return Core(tmp_path_factory.mktemp("root"), a76.build_plugin())


def test_a_known_program_is_counted_exactly(plugin_only, tmp_path):
    code = [*mark(1), *mov(9, ROUNDS), *LOOP, *mark(0), *mov(8, 93), *mov(0, 0), SVC]
    done = emulate(plugin_only, [program(tmp_path / "loop", code)], tmp_path)
    assert set(done.sections) == {SECTION}
    assert done.total(SECTION) == 1 + ROUNDS * len(LOOP) + len(mark(0))
    assert done.total(SECTION, "simd") == 2 * ROUNDS
    assert done.total(SECTION, "sdot") == ROUNDS
    # A round dispatches four instructions in a cycle, and takes one more to go on to the next.
    assert done.cycles(SECTION) == pytest.approx(2 * ROUNDS, rel=0.01)


@pytest.mark.parametrize(
    ("words", "cycles"),
    [
        ([0x4E829420] * 6, 3),  # sdot: two a cycle
        ([0x4E21D820], 2),  # scvtf v0.4s, v1.4s: the first pipe converts, in two cycles
        ([0x4C402160] * 2, 4),  # ld1 of four registers
        ([0x3D800160] * 3, 3),  # str q0: one a cycle
    ],
)
def test_instructions_wait_for_their_ports(plugin_only, tmp_path, words, cycles):
    first = 0xD10043EB  # sub x11, sp, #16
    loop = [*words, 0xF1000529, 0x54000001 | (-(len(words) + 1) & 0x7FFFF) << 5]
    code = [first, *mov(9, ROUNDS), *mark(1), *loop, *mark(0), *mov(8, 93), *mov(0, 0), SVC]
    done = emulate(plugin_only, [program(tmp_path / "loop", code)], tmp_path)
    busiest = max(cycles, len(loop) / 4)
    assert done.cycles(SECTION) == pytest.approx((busiest + 1) * ROUNDS, rel=0.01)


READ, WRITE = 0xF8440400 | 11 << 5 | 10, 0xF8040400 | 11 << 5 | 10  # ldr, str x10, [x11], #64


@pytest.mark.parametrize(
    ("access", "lines", "passes", "near", "far"),
    [
        (READ, 512, 3, 512, 512),  # 32 KB stay in the first cache
        (READ, 4096, 2, 8192, 4096),  # 256 KB stay in the second
        (READ, 16384, 2, 32768, 16384),  # 1 MB stay in the one that the cores share
        (READ, 65536, 2, 131072, 131072),  # 4 MB stay nowhere
        (WRITE, 512, 3, 0, 1024),  # what is written goes back
    ],
)
def test_lines_are_counted_by_the_cache_that_lacks_them(plugin_only, tmp_path, access, lines, passes, near, far):
    start = 0xD1400000 | 0x400 << 10 | 31 << 5 | 11  # sub x11, sp, #4 MB
    loop = [access, 0xF1000529, 0x54000001 | (-2 & 0x7FFFF) << 5]  # the access; subs x9, x9, #1; b.ne to it
    code = [*mark(1), *[word for _ in range(passes) for word in (start, *mov(9, lines), *loop)], *mark(0)]
    path = program(tmp_path / "walks", [*code, *mov(8, 93), *mov(0, 0), SVC])
    done = emulate(plugin_only, [path], tmp_path, watch=f"memory={SECTION}")
    assert done.lines(SECTION) == (near, far)


def test_kernels_are_summed_and_the_rest_is_other():
    rows = [(1, 10, 5, 2, 1, 9), (2, 1, 5, 0, 0, 9), (3, 100, 1, 1, 0, 6), (4, 1, 1, 0, 0, 5)]
    names = {1: "_Z3fooi", 2: "_Z3fooi", 3: "bar", 4: "baz"}
    kernels = by_kernel(np.array(rows, BLOCK), names, at_most=2)
    assert kernels == {"bar": 100, "foo": 55, "other": 1}


@pytest.fixture(scope="module")
def tiny_run(thin, tmp_path_factory) -> Path:
    """A run's folder with artifacts of the tests' thin policy, always the same."""
    folder = tmp_path_factory.mktemp("run")
    (checkpoint, calibration), samples = thin, memory_samples(16)
    exporter = Exporter(checkpoint, samples[:1])  # each parity vector takes the emulated core a while
    exporter.export(ACT(checkpoint.config, checkpoint.weights), folder / "policy_fp32.pt")
    static = q.quantize(checkpoint, q.Scheme("static"), calibration)
    for name in ("policy_static.pt", "policy_static.onnx.zip"):
        exporter.export(static, folder / name, calibration)
    return folder


@pytest.fixture(scope="module")
def core(users_cache) -> Core:
    return prepare()


@pytest.fixture(scope="module")
def count(core, thin, tiny_run):
    """count(off): count_run on held-out frames from memory. FP32 is not emulated, but predicts as here, so much off.

    Importing torch takes the emulated core half a minute, which is spent on static INT8 alone.
    """
    recordings = SimpleNamespace(action_range=lambda: {"steering": (-0.5, 0.5), "throttle": (0.0, 0.1)})
    parts = SimpleNamespace(held_out=memory_samples(12, seed=1))
    again = SimpleNamespace(checkpoint=thin[0], parts=parts, recordings=recordings)
    full = read_stage(Path(__file__).parents[3] / "results/full/arm.json", "arm")["metrics"]["artifacts"]["policy_fp32"]

    def run(off: float) -> dict:
        def count_artifact(core, path, manifest, samples, **options):
            if path.stem != "policy_fp32":
                return counting_really(core, path, manifest, samples, **options)
            return Counted(full, counting.chunks_here(path, samples, silent) + np.float32(off))

        counting_really = counting.count_artifact
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(counting, "count_artifact", count_artifact)
            patch.setattr(counting, "open_run", lambda run_dir: again)
            return count_run(tiny_run, frames=12)

    return run


@pytest.fixture(scope="module")
def report(count) -> dict:
    return count(0.0)


def test_a_run_is_counted(report, tiny_run):
    assert read_stage(tiny_run / "arm.json", "arm") == report
    assert report["metrics"]["label"] == "counted on an emulated Cortex-A76"
    fp32, static = (report["metrics"]["artifacts"][stem] for stem in ("policy_fp32", "policy_static"))
    assert 0 < static["sdot_g"] < static["simd_g"] < static["instructions_g"]
    assert sum(static["instructions_by_kernel"].values()) == pytest.approx(static["instructions_g"])
    assert any("neondot" in kernel for kernel in static["instructions_by_kernel"])
    assert fp32["workstation_steering_mae_pct"] == fp32["steering_mae_pct"] == static["reference_max_difference"] == 0
    assert 0 < static["steering_mae_pct"] < 2 * static["workstation_steering_mae_pct"]
    assert 100 < static["peak_memory_mb"] < 500
    assert static["threads"] == 1 and (static["frames_on_the_core"], fp32["frames_on_the_core"]) == (12, STEADY)
    assert 0 < static["far_lines_g"] < static["near_lines_g"] < 0.1 * static["instructions_g"]
    assert static["computed_pi5_ms"] == pi5.predict_ms(static) | {"threads": pi5.DRIVING}
    assert "policy_static" in reports.table(report)
    warm = [static[f"{n}_g"] for n in ("first", "second", "tenth")]
    assert warm == pytest.approx([static["instructions_g"]] * 3, rel=0.01)
    for stem, (budget_m, leeway) in BUDGETS_M.items():
        counted_m = 1e3 * report["metrics"]["artifacts"][stem]["instructions_g"]
        assert counted_m == pytest.approx(budget_m, rel=leeway), f"{stem}: set BUDGETS_M if it is meant"


def test_what_onnx_runtime_runs_is_counted_like_the_rest(report):
    torchs, onnx = (report["metrics"]["artifacts"][f"policy_static{kind}"] for kind in ("", ".onnx"))
    assert onnx.keys() == torchs.keys() and onnx["reference"] == torchs["reference"]
    assert "torch" not in onnx["versions"]
    assert onnx["sdot_g"] == pytest.approx(torchs["sdot_g"], rel=0.1)  # the same products, in stacks of columns
    assert 0 < onnx["steering_mae_pct"] < 1.5 * torchs["steering_mae_pct"]
    assert onnx["peak_memory_mb"] < torchs["peak_memory_mb"] - 100  # torch alone is more


def test_an_fp32_that_differs_on_the_core_is_no_reference(count, tiny_run, monkeypatch):
    monkeypatch.setattr(counting, "side_by_side", lambda jobs, *_: {"policy_fp32": jobs["policy_fp32"]()})
    with pytest.raises(RoverError, match=r"policy_fp32\.pt: differs by .* on the core"):
        count(0.5)
