"""Count published networks, and policies of ours with random weights, in the emulated Pi: what the clock predicts from.

A count depends on shapes and kernels, not on weights or pictures. ncnn's graphs are read from a user's copy of its
benchmark/models, ExecuTorch's programs are made here of torchvision's networks.
"""

import csv
import math
import os
import re
import sys
import tempfile
import threading
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lab.a76 import peers
from lab.a76.core import FOR_GUEST, GUEST, Core, CountError, Emulation, emulate_script, fetch_wheels
from lab.a76.count import STEADY, count_artifact
from lab.a76.report import work_of
from rover_learn.channels import kept_of
from rover_learn.train import SIZES
from rover_lib.onboard.artifact.manifest import read_manifest
from rover_lib.workshop import act
from rover_lib.workshop.act import ACT, ActConfig, expected_shapes
from rover_lib.workshop.cache import cache_folder, key_of
from rover_lib.workshop.checkpoint.checkpoint import Checkpoint
from rover_lib.workshop.int8 import export, observe, quantize
from rover_lib.workshop.int8.scheme import Scheme
from rover_lib.workshop.run_program import run

PUBLISHED = Path(__file__).with_name("published.csv")
SOURCES = {  # of a runtime's times; read in November 2026
    "ncnn": "ncnn's benchmark/README.md, a Raspberry Pi 5 at 2.4 GHz, least of 10; read 2026-11",
    "executorch": "Arm's model cards and ExecuTorch course, XNNPACK on a Raspberry Pi 5, median; read 2026-11",
}
NCNN = "ncnn==1.0.20240102"  # the release after its times on a Pi 5 were published, on 12 December 2023
TOO_SLOW = ("ncnn/vgg16/fp16", "ncnn/vision_transformer/fp16")  # the emulator has no FP16 of its own: many minutes each
(EXECUTORCH,) = [engine for engine in peers.ENGINES if engine.name == "executorch"]
TORCHVISION = "torchvision==0.25.0"  # the one for the torch that ExecuTorch's tools come with
THREADS = 4
TRACING = threading.Lock()  # two policies cannot be traced at once: torch.fx patches modules for the whole process
SECTION = 1  # of the one network that guest/network.py runs
GRAPHS = "--ncnn FOLDER: benchmark in a copy of ncnn's repository at its tag 20240102"


@dataclass(frozen=True)
class Published:
    """A network whose time on a Raspberry Pi 5 was published. ms: by threads. px: the side of its picture."""

    name: str
    runtime: str
    precision: str
    px: int
    ms: dict[int, float]

    @property
    def key(self) -> str:
        return f"{self.runtime}/{self.name}/{self.precision}"


def read_published() -> list[Published]:
    """Read the published times that are kept beside this module."""
    with PUBLISHED.open(newline="") as file:
        return [
            Published(
                r["name"],
                r["runtime"],
                r["precision"],
                int(r["px"]),
                {n: float(r[f"ms_{n}"]) for n in (1, THREADS) if r[f"ms_{n}"]},
            )
            for r in csv.DictReader(file)
        ]


# --- networks ---------------------------------------------------------------------------------------------------------


def count_network(core: Core, network: Published, graphs: Path | None) -> dict[str, float]:
    """Count a network of ncnn in one thread and in four, or make one for ExecuTorch and count it in one.

    graphs: the folder of ncnn's own .param files. Raises CountError if the network's is not there.
    """
    if network.runtime == "executorch":
        ran = _emulate(core, network, _program(network), packages=peers.packages_there(EXECUTORCH), watch="memory=0")
        # All of these networks run in XNNPACK, which divides them into small tiles.
        return _work_of(ran) | {"alone": 0.0}
    graph = (graphs or Path()).resolve() / f"{network.name}.param"
    if not graphs or not graph.is_file():
        raise CountError(
            f"{network.name}: ncnn's graph of it is needed to count it", found=graphs or "no folder", remedy=GRAPHS
        )

    def make(folder: Path) -> None:
        fetch_wheels(folder, *FOR_GUEST, NCNN)

    packages = cache_folder("arm-ncnn", key_of({"packages": NCNN, "for": FOR_GUEST}), make)
    alone = _emulate(core, network, graph, packages=packages, watch="memory=0")
    together = _emulate(core, network, graph, packages=packages, watch="threads=1", threads=THREADS)
    busiest, *others = together.by_thread(SECTION)
    share = busiest / (busiest + sum(others))
    # The thread that calls has the largest part of what is divided too, so this share holds what is uneven in that.
    return _work_of(alone) | {"alone": max(0.0, (THREADS * share - 1) / (THREADS - 1))}


def _emulate(core: Core, network: Published, path: Path, *, threads: int = 1, **options: Any) -> Emulation:
    with tempfile.TemporaryDirectory(prefix="rover-clock-") as scratch:
        given = [network.runtime, threads, f"{network.px}:{path}"]
        return emulate_script(core, GUEST / "network.py", given, Path(scratch), threads=threads, **options)


def _program(network: Published) -> Path:
    maker = peers.FOLDER / "make_network.py"
    packages = (*EXECUTORCH.packages, TORCHVISION)

    def fetch(folder: Path) -> None:
        fetch_wheels(folder, "--python", sys.executable, TORCHVISION)

    def make(folder: Path) -> None:
        vision = cache_folder("peer-torchvision", key_of({"packages": TORCHVISION}), fetch)
        places = os.pathsep.join(map(str, (peers.packages_here(EXECUTORCH), vision)))
        command = [sys.executable, maker, network.name, network.precision, folder / "network.pte"]
        run(*command, error=CountError, env={**os.environ, "PYTHONPATH": places})

    key = key_of({"network": network.key, "packages": packages}, maker)
    return cache_folder("peer-network", key, make) / "network.pte"


def _work_of(ran: Emulation) -> dict[str, float]:
    counts = {"instructions": ran.total(SECTION), "simd": ran.total(SECTION, "simd"), "cycles": ran.cycles(SECTION)}
    counts |= {"near_lines": ran.near_lines(SECTION), "far_lines": ran.far_lines(SECTION)}
    return {f"{name}_g": count / 1e9 for name, count in counts.items()}


# --- policies ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Shape:
    """A policy of ours. backbone_channels: the share of its backbone's inner channels that it computes."""

    name: str
    config: ActConfig
    mode: str = "static"
    backbone_channels: float | None = None

    def row(self) -> dict[str, Any]:
        """Return what tells it from the others, as rows of distill.json say it."""
        c = self.config
        ((height, width),) = c.image_sizes
        size = {"height": height, "width": width, "decoder_layers": c.decoder_layers, "feedforward": c.feedforward}
        return {"name": self.name, "mode": self.mode, **size, "backbone_channels": self.backbone_channels}


FULL, SMALL = (replace(SIZES[size], vae_layers=0) for size in ("full", "small"))
FAST = replace(FULL, image_sizes=((180, 320),), decoder_layers=2, feedforward=1600)
POLICIES = (
    Shape("teacher", FULL),
    Shape("teacher at 320x180", replace(FULL, image_sizes=((180, 320),))),
    Shape("fast", FAST),
    Shape("faster", FAST, backbone_channels=0.5),
    Shape("demo", SMALL),
    Shape("half", SMALL, backbone_channels=0.5),
    Shape("quarter", SMALL, backbone_channels=0.25),
    Shape("demo-small", replace(SMALL, image_sizes=((54, 96),), feedforward=256)),
)


@dataclass(frozen=True, eq=False)
class _Noise:
    state: np.ndarray
    picture: np.ndarray
    episode: str = "noise"
    row: int = 0

    def frame_bgr(self) -> np.ndarray:
        return self.picture


def count_policy(core: Core, shape: Shape) -> dict[str, Any]:
    """Make a policy of that shape with random weights, and count it. Returns its counts and its manifest's gmac."""
    rng, ((height, width),) = np.random.default_rng(0), shape.config.image_sizes
    noise: Any = [_Noise(np.zeros(2, np.float32), rng.integers(0, 256, (height, width, 3), np.uint8)) for _ in range(2)]

    def make(folder: Path) -> None:
        with TRACING:
            weights = random_weights(shape.config, shape.backbone_channels)
            checkpoint = Checkpoint(folder / "none", "trainer", shape.config, weights, "0" * 64, {})
            calibration = None if shape.mode == "fp32" else observe.calibrate(checkpoint, noise)
            policy: Any = ACT(shape.config, weights)
            if calibration:
                policy = quantize.quantize(checkpoint, Scheme(shape.mode), calibration)
            export.export(policy, checkpoint, folder / "policy.pt", noise, calibration)

    key = key_of({"shape": repr(shape)}, act, observe, quantize, export)
    path = cache_folder("clock-policy", key, make) / "policy.pt"
    counted = count_artifact(core, path, noise, counted=STEADY)
    return work_of(counted) | {"gmac": read_manifest(path)["gmac"]}


def random_weights(config: ActConfig, backbone_channels: float | None = None) -> dict[str, torch.Tensor]:
    """Return weights of a policy's shape, with zeros for the channels that its backbone does not compute."""
    random, weights = torch.Generator().manual_seed(0), {}
    for name, size in expected_shapes(config).items():
        if len(size) == 1:
            weights[name] = torch.full(size, float(name.endswith(("weight", "running_var"))))
        else:
            weights[name] = torch.randn(size, generator=random) / math.sqrt(math.prod(size[1:]))
    for name in [n for n in weights if backbone_channels and re.search(r"layer\d\.\d\.bn1\.weight$", n)]:
        block, kept = name.removesuffix("bn1.weight"), kept_of(len(weights[name]), backbone_channels or 1)
        for part in ("conv1.weight", "bn1.weight", "bn1.bias"):
            weights[block + part][kept:] = 0
        weights[block + "conv2.weight"][:, kept:] = 0
    return weights
