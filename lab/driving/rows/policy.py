"""Faults of the policy: it raises, hangs, gives nonsense or dies, or its file changes."""

import os
import signal

from lab.driving.bench import DrivingBench
from lab.driving.pins import CONTINUES, REFUSED, STOPPED
from lab.driving.policy import HANG, NAN, OUT_OF_RANGE, PLAIN, RAISE, SLOW
from lab.driving.row import FaultKind

FAULTS = FaultKind("policy")


def _by_picture(name: str, instruction: int, message: str) -> None:
    FAULTS.add(name, STOPPED, message, "the picture tells the policy to")(lambda bench: bench.show(instruction))


_by_picture("inference raises", RAISE, "told to fail by the picture")
_by_picture("inference returns NaN", NAN, "NaN or Inf|not finite")
_by_picture("inference returns out of range", OUT_OF_RANGE, "outside the range")


@FAULTS.add("inference process killed", STOPPED, r"process ended \(SIGKILL\)", "SIGKILL to the child of rover drive")
def _kill_inference(bench: DrivingBench) -> None:
    bench.signal_children(signal.SIGKILL)


@FAULTS.add(
    "inference hangs for 300 ms",
    CONTINUES,
    "the policy took",
    "the picture tells the policy to",
    limits="as 'inference hangs', when it is longer",
)
def _slow_inference(bench: DrivingBench) -> None:
    bench.show(SLOW)
    bench.wait(0.05)
    bench.show(PLAIN)
    bench.wait(0.5)


@FAULTS.add(
    "artifact swapped on disk",
    CONTINUES,
    "changed on disk",
    "another file is renamed onto it",
    watch_s=1.6,
    limits="none: the loaded policy drives on; the next start checks the new file",
)
def _swap(bench: DrivingBench) -> None:
    kept, other = bench.folder / "kept.pt", bench.folder / "other.pt"
    os.link(bench.artifact, kept)
    bench.undo.callback(kept.replace, bench.artifact)
    other.write_bytes(b"no artifact")
    other.replace(bench.artifact)


@FAULTS.add(
    "inference hangs",
    CONTINUES,
    "the policy has not answered",
    "the picture tells the policy to loop for ever",
    watch_s=2.0,
    until_limit=True,
    exit_code=3,
)
def _hang_inference(bench: DrivingBench) -> None:
    bench.show(HANG)


@FAULTS.add("inference raises at the start", REFUSED, "told to fail by the picture", "the picture tells the policy to")
def _raise_before(bench: DrivingBench) -> None:
    bench.show(RAISE)


@FAULTS.add("inference returns NaN at the start", REFUSED, "NaN or Inf|not finite", "the picture tells the policy to")
def _nan_before(bench: DrivingBench) -> None:
    bench.show(NAN)


@FAULTS.add("artifact damaged", REFUSED, "damaged|checksum", "a byte of the file is another, before the drive")
def _damage(bench: DrivingBench) -> None:
    data = bytearray(bench.artifact.read_bytes())
    bench.undo.callback(bench.artifact.write_bytes, bytes(data))
    data[len(data) // 2] ^= 1
    bench.artifact.write_bytes(data)


@FAULTS.add("artifact gone", REFUSED, "not found", "the file is renamed before the drive")
def _hide(bench: DrivingBench) -> None:
    hidden = bench.artifact.rename(bench.folder / "hidden.pt")
    bench.undo.callback(hidden.rename, bench.artifact)


@FAULTS.add(
    "inference process stopped",
    CONTINUES,
    "the policy has not answered",
    "SIGSTOP to the child of rover drive",
    watch_s=2.0,
    until_limit=True,
    exit_code=3,
)
def _stop_inference(bench: DrivingBench) -> None:
    bench.signal_children(signal.SIGSTOP)
