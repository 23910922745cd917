"""The ruler against what is known: a program whose instructions can be counted by hand, and itself."""

import os
import struct
import subprocess
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from policies import memory_samples

from rover_lib.onboard.stage import read_stage
from rover_lib.workshop import arm
from rover_lib.workshop import quantize as q
from rover_lib.workshop.act import ACT
from rover_lib.workshop.arm import ArmError, Machine, count_artifact, count_run, emulate, prepare
from rover_lib.workshop.checkpoint import load_checkpoint
from rover_lib.workshop.params import params

MISSING = arm.missing_packages()
pytestmark = [
    pytest.mark.emulated,
    pytest.mark.skipif(bool(MISSING), reason=f"needs the Debian packages {' '.join(MISSING)}"),
]

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
def plugin_only(tmp_path_factory) -> Machine:
    """Enough for a static program: no userland."""
    return Machine(tmp_path_factory.mktemp("root"), arm._plugin())


def test_a_known_program_is_counted_exactly(plugin_only, tmp_path):
    code = [*mark(1), *mov(9, ROUNDS), *LOOP, *mark(0), *mov(8, 93), *mov(0, 0), SVC]
    done = emulate(plugin_only, [program(tmp_path / "loop", code)], tmp_path)
    assert set(done.sections) == {SECTION}
    assert done.total(SECTION) == 1 + ROUNDS * len(LOOP) + len(mark(0))
    assert done.total(SECTION, "simd") == 2 * ROUNDS
    assert done.total(SECTION, "sdot") == ROUNDS


def test_a_program_that_fails_ends_in_a_sentence(plugin_only, tmp_path):
    with pytest.raises(ArmError, match=r"ended with 3 after its start: it said nothing"):
        emulate(plugin_only, [program(tmp_path / "fails", [*mov(8, 93), *mov(0, 3), SVC])], tmp_path)


def test_what_hangs_is_ended(plugin_only, tmp_path, monkeypatch):
    monkeypatch.setattr(arm, "SILENCE_S", 0.5)
    hangs = program(tmp_path / "hangs", [0x14000000])  # a branch to itself
    with pytest.raises(ArmError, match=r"said nothing for 0\.5 s"):
        emulate(plugin_only, [hangs], tmp_path)
    running = [p / "cmdline" for p in Path("/proc").iterdir() if p.name.isdigit()]
    assert not any(str(hangs).encode() in p.read_bytes() for p in running if os.access(p, os.R_OK))


def test_functions_are_named_by_address(tmp_path):
    source = tmp_path / "two.c"
    source.write_text("int first(int a) { return a * 3; }\nint second(int a) { return first(a) - 1; }\n")
    subprocess.run(["gcc", "-shared", "-fPIC", "-o", tmp_path / "two.so", source], check=True)
    listing = subprocess.run(["nm", tmp_path / "two.so"], capture_output=True, text=True, check=True).stdout
    at = {name: int(address, 16) for address, kind, name in (x.split() for x in listing.splitlines() if x[0] == "0")}
    library = tmp_path / "two.so"
    names = arm.Names(
        f"5000000000-5000010000 r-xp 00000000 08:01 1234    {library}\n5000010000-5000011000 rw-p 0 0:0 0\n"
    )
    assert names[0x5000000000 + at["first"]] == names[0x5000000000 + at["second"] - 1] == "first"
    assert names[0x5000000000 + at["second"] + 4] == "second"
    assert names[0x5000010010] == names[0x10] == "[unknown]"
    with pytest.raises(ArmError, match="not a 64-bit ELF"):
        arm.Binary(source)


def test_kernels_are_summed_and_the_rest_is_other():
    rows = [(1, 10, 5, 2, 1), (2, 1, 5, 0, 0), (3, 100, 1, 1, 0), (4, 1, 1, 0, 0)]
    names = {1: "_Z3fooi", 2: "_Z3fooi", 3: "bar", 4: "baz"}
    found = arm.by_kernel(np.array(rows, arm.BLOCK), names, at_most=2)
    assert found == {"bar": (100, 100, 0), "foo": (55, 20, 10), "other": (1, 0, 0)}


def test_an_image_size_is_judged_by_fp32_of_its_own():
    there = ("policy_fp32", "policy_fp32_180x320", "policy_static")
    assert arm.reference_of("policy_static", there) == "policy_fp32"
    assert arm.reference_of("policy_static_180x320", there) == "policy_fp32_180x320"
    assert arm.reference_of("policy_static_240x432", there) == "policy_fp32"


def test_packages_are_named_when_they_cannot_be_installed(monkeypatch):
    monkeypatch.setattr(arm, "missing_packages", lambda: ["qemu-user"])
    monkeypatch.setattr(arm.os, "geteuid", lambda: 1000)
    with pytest.raises(ArmError, match=r"Debian packages qemu-user, .*: sudo apt-get install"):
        arm._install_missing()


@pytest.fixture(scope="module")
def machine() -> Machine:
    return prepare()


@pytest.fixture(scope="module")
def tiny_run(tiny_file, tmp_path_factory) -> Path:
    """A run's folder with two artifacts of the tests' small policy, always the same."""
    folder = tmp_path_factory.mktemp("run")
    checkpoint, samples = load_checkpoint(tiny_file), memory_samples(16)
    calibration = q.calibrate(checkpoint, samples)
    options = {"samples": samples[:3]}
    q.export(ACT(checkpoint.config, checkpoint.weights), checkpoint, folder / "policy_fp32.pt", **options)
    static = q.quantize(checkpoint, q.Scheme("static"), calibration)
    q.export(static, checkpoint, folder / "policy_static.pt", calibration=calibration, **options)
    return folder


@pytest.fixture(scope="module")
def report(machine, tiny_run) -> dict:
    """count_run on held-out frames from memory."""
    recordings = SimpleNamespace(action_range=lambda: {"steering": (-0.5, 0.5), "throttle": (0.0, 0.1)})
    again = SimpleNamespace(parts=SimpleNamespace(held_out=memory_samples(12, seed=1)), recordings=recordings)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(arm, "opened", lambda run_dir: again)
        return count_run(tiny_run, frames=12)


def test_a_run_is_counted(report, tiny_run):
    assert read_stage(tiny_run / "arm.json", "arm") == report
    assert report["metrics"]["label"] == "counted on an emulated Cortex-A76"
    fp32, static = (report["metrics"]["artifacts"][stem] for stem in ("policy_fp32", "policy_static"))
    assert fp32["sdot_g"] == 0 < static["sdot_g"] < static["simd_g"] < static["instructions_g"] < fp32["instructions_g"]
    assert sum(static["instructions_by_kernel"].values()) == pytest.approx(static["instructions_g"])
    assert any("neondot" in kernel for kernel in static["instructions_by_kernel"])
    assert static["reference_max_difference"] < 1e-4
    assert fp32["steering_mae_pct"] == fp32["throttle_mae_pct"] == 0
    assert 0 < static["steering_mae_pct"] < 2 * static["workstation_steering_mae_pct"]
    assert 100 < static["peak_memory_mb"] < 500
    assert static["threads"] == 1
    assert "policy_static" in arm.table(report)


def test_a_count_is_repeatable(report, machine, tiny_run):
    again = count_artifact(machine, tiny_run / "policy_static.pt", memory_samples(12, seed=1)[:3], counted=3)
    assert again.steady / 1e9 == pytest.approx(
        report["metrics"]["artifacts"]["policy_static"]["instructions_g"], rel=0.002
    )


def test_a_loaded_policy_is_warm(report):
    static = report["metrics"]["artifacts"]["policy_static"]
    for which in ("first_g", "second_g", "tenth_g"):
        assert static[which] == pytest.approx(static["instructions_g"], rel=0.01), which


def test_counts_stay_within_their_budget(report):
    budgets = params()["arm"]["budget_m"]
    assert budgets
    for stem, budget_m in budgets.items():
        found_m = report["metrics"]["artifacts"][stem]["instructions_g"] * 1e3
        assert found_m == pytest.approx(budget_m, rel=0.02), f"{stem}: set params.yml's arm.budget_m if it is meant"


def test_what_the_guest_refuses_is_said_in_its_words(machine, tiny_run, tmp_path):
    broken = tmp_path / "broken.pt"
    broken.write_bytes((tiny_run / "policy_static.pt").read_bytes()[:-1000])
    with pytest.raises(ArmError, match=r"ended with 1 after load: error: .*broken\.pt: not an artifact, or cut short"):
        count_artifact(machine, broken, memory_samples(1), counted=3)
