"""Stand in for Raspberry Pi OS's rpicam-vid: JPEGs from a FIFO or a folder, as `--codec mjpeg --metadata` writes them.

It is not libcamera, and proves nothing about a camera. It takes only options that rpicam-apps' core/options.cpp and
core/video_options.hpp have, and writes what output/output.cpp does. ROVER_CSI names the JPEGs. ROVER_CSI_FAULT is for
tests: `silent` gives nothing, `cut N` ends the Nth JPEG half way, `gone` finds no camera, `freeze N` and `die N` do so
after N, `lose N` writes no metadata of the Nth. An emulated Pi runs this file alone, so it needs nothing else.
"""

import argparse
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path

PROGRAM = "rpicam-vid"
OPTIONS = ["camera", "width", "height", "framerate", "timeout", "codec", "quality", "output", "verbose", "metadata"]
OPTIONS += ["metadata-format", "shutter", "gain", "ev", "exposure", "awb", "rotation"]


def install(folder: Path) -> Path:
    """Make a program of this module in a folder, for PATH, and return the folder."""
    program = folder / PROGRAM
    program.write_text(f"#!{sys.executable}\n{Path(__file__).read_text()}")
    program.chmod(0o755)
    return folder


def _pictures(source: Path, rate_hz: float) -> Iterator[bytes]:
    if source.is_fifo():
        pending = b""
        with source.open("rb", buffering=0) as fifo:
            while data := fifo.read(1 << 20):
                *whole, pending = (pending + data).split(b"\xff\xd9")
                yield from (jpeg + b"\xff\xd9" for jpeg in whole)
        return
    while True:
        for path in sorted(source.glob("*.jpg")):
            time.sleep(1 / rate_hz)
            yield path.read_bytes()


def main() -> None:
    """Do what rpicam-vid does with these options, until it is killed or its reader goes."""
    parser = argparse.ArgumentParser(PROGRAM, allow_abbrev=False)
    for name in ("nopreview", "flush"):
        parser.add_argument(f"--{name}", action="store_true", required=True)
    for name in OPTIONS:
        parser.add_argument(f"--{name}")
    o = parser.parse_args()
    assert (o.timeout, o.codec, o.output, o.metadata_format) == ("0", "mjpeg", "-", "txt"), o
    fault, _, number = os.environ.get("ROVER_CSI_FAULT", "").partition(" ")
    if fault == "gone":
        sys.exit("ERROR: *** no cameras available ***")
    with open(o.metadata, "w") as entries:  # noqa: PTH123  # as an ofstream does
        for n, jpeg in enumerate(_pictures(Path(os.environ["ROVER_CSI"]), float(o.framerate)), 1):
            stamp_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME) - 5_000_000
            if fault == "silent" or (fault == "freeze" and n > int(number)):
                continue
            if fault == "die" and n > int(number):
                sys.exit("ERROR: *** failed to write output bytes ***")
            sys.stdout.buffer.write(jpeg[: len(jpeg) // 2] if fault == "cut" and n == int(number) else jpeg)
            sys.stdout.buffer.flush()
            if fault == "lose" and n == int(number):
                continue
            entries.write(f"ExposureTime={o.shutter or 9000}\nSensorTimestamp={stamp_ns}\nDigitalGain=1.000000\n\n")
            entries.flush()


if __name__ == "__main__":
    main()
