"""How to quantize, as a value: what `observe` prepares for, `quantize` carries out and `choose` tries."""

from dataclasses import dataclass

import torch

from rover_lib.onboard.errors import QuantizeError

ENGINE = "qnnpack"
MODES = ("dynamic", "static", "mixed")
# XNNPACK's fast kernels want symmetric int8 activations and weights in [-127, 127] with scales of at least 2^-12;
# quint8 falls back to QNNPACK's kernels, which have no dot-product instructions in the wheel.
KINDS = {"symmetric": (torch.qint8, -128, 127), "affine": (torch.quint8, 0, 255)}
OBSERVERS = ("histogram", "minmax", "percentile")
SMALLEST_SCALE = 2**-12
STAYS_FLOAT = ("head", "state_project")


@dataclass(frozen=True)
class Scheme:
    """How to quantize. A scheme that exists is valid.

    mode: dynamic (INT8 weights of linears, activations quantized on the fly), static (both, calibrated), or mixed
    (static with `float_blocks` left in float). kind: of the activations of static and mixed. observer: how a range is
    read off what was seen. smooth: SmoothQuant's a of the channel scales, None for no scales.
    """

    mode: str = "static"
    kind: str = "symmetric"
    observer: str = "histogram"
    smooth: float | None = 0.5
    percentile: float = 99.99
    float_blocks: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name, value, known in (
            ("mode", self.mode, MODES),
            ("kind", self.kind, tuple(KINDS)),
            ("observer", self.observer, OBSERVERS),
        ):
            if value not in known:
                raise QuantizeError(f"scheme: {name} {value!r} is not known", remedy=f"known are {list(known)}")
        if self.smooth is not None and not 0 <= self.smooth <= 1:
            raise QuantizeError("scheme: smooth must be in [0, 1]", found=self.smooth)
        if not 50 < self.percentile <= 100:
            raise QuantizeError("scheme: percentile must be in (50, 100]", found=self.percentile)
