"""How to quantize, as a value: what `observe` prepares for, `quantize` carries out and `choose` tries."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch

from rover_lib.onboard.errors import ArtifactError

ENGINE = "qnnpack"
MODES = ("dynamic", "static", "mixed")
# XNNPACK's fast kernels want symmetric int8 activations and weights in [-127, 127] with scales of at least 2^-12;
# quint8 falls back to QNNPACK's kernels, which have no dot-product instructions in the wheel.
KINDS = {"symmetric": (torch.qint8, -128, 127), "affine": (torch.quint8, 0, 255)}
OBSERVERS = ("histogram", "minmax", "percentile", "frames")
SMALLEST_SCALE = 2**-12
STAYS_FLOAT = ("head", "state_project")


@dataclass(frozen=True)
class Scheme:
    """How to quantize. A scheme that exists is valid.

    mode: dynamic (INT8 weights of linears, activations quantized on the fly), static (both, calibrated), or mixed
    (static with `float_blocks` left in float). kind: of the activations of static and mixed. smooth: SmoothQuant's a,
    None for no channel scales. usual_pct: the share of frames of which the observer `frames` takes the extremes. wider:
    (place, share) of tensors whose range reaches further, see `frames`.
    """

    mode: str = "static"
    kind: str = "symmetric"
    observer: str = "histogram"
    smooth: float | None = 0.5
    percentile: float = 99.99
    float_blocks: tuple[str, ...] = ()
    usual_pct: float = 100.0
    wider: tuple[tuple[str, float], ...] = ()

    @classmethod
    def of(cls, stored: Mapping[str, Any]) -> "Scheme":
        """A scheme from JSON, which has lists for its tuples."""
        wider = tuple((place, share) for place, share in stored.get("wider", ()))
        return cls(**{**stored, "float_blocks": tuple(stored["float_blocks"]), "wider": wider})

    def __post_init__(self) -> None:
        known = {"mode": MODES, "kind": tuple(KINDS), "observer": OBSERVERS}
        for name, values in known.items():
            if (value := getattr(self, name)) not in values:
                raise ArtifactError(f"scheme: {name} {value!r} is not known", remedy=f"known are {list(values)}")
        shares = {"smooth": self.smooth or 0, "usual_pct": self.usual_pct / 100, **dict(self.wider)}
        if not 50 < self.percentile <= 100 or not all(0 <= share <= 1 for share in shares.values()):
            what = "scheme: percentile must be in (50, 100], usual_pct in [0, 100], smooth and wider in [0, 1]"
            raise ArtifactError(what, found=f"{self.percentile} and {shares}")
