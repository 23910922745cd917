"""How to quantize, as a value: what `observe` prepares for, `quantize` carries out and `choose` tries."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from rover_lib.onboard.errors import ArtifactError

ENGINE = "qnnpack"
MODES = ("dynamic", "static", "mixed")
# XNNPACK's fast kernels want int8 activations and weights in [-127, 127] with scales of at least 2^-12; quint8, as is
# usual, falls back to QNNPACK's kernels, which have no dot-product instructions in the wheel.
LOW, HIGH = -128, 127  # of activations, qint8
OBSERVERS = ("histogram", "minmax", "frames")
SMALLEST_SCALE = 2**-12
STAYS_FLOAT = ("head", "state_project")


@dataclass(frozen=True)
class Scheme:
    """How to quantize. A scheme that exists is valid.

    mode: dynamic (INT8 weights of linears, activations quantized on the fly), static (both, calibrated), or mixed
    (static with `float_blocks` left in float). smooth: SmoothQuant's a, None for no channel scales. usual_pct: the
    share of frames of which the observer `frames` takes the extremes. wider: (place, share) of tensors whose range
    reaches further, see `frames`.
    """

    mode: str = "static"
    observer: str = "histogram"
    smooth: float | None = 0.5
    float_blocks: tuple[str, ...] = ()
    usual_pct: float = 100.0
    wider: tuple[tuple[str, float], ...] = ()

    @classmethod
    def of(cls, stored: Mapping[str, Any]) -> "Scheme":
        """A scheme from JSON, which has lists for its tuples."""
        tuples = {"float_blocks": tuple(stored["float_blocks"]), "wider": tuple(map(tuple, stored["wider"]))}
        return cls(**{**stored, **tuples})

    def __post_init__(self) -> None:
        choices = {"mode": MODES, "observer": OBSERVERS}
        for name, values in choices.items():
            if (value := getattr(self, name)) not in values:
                raise ArtifactError(f"scheme: {name} {value!r} is not known", remedy=f"known are {list(values)}")
        shares = {"smooth": self.smooth or 0, "usual_pct": self.usual_pct / 100, **dict(self.wider)}
        if not all(0 <= share <= 1 for share in shares.values()):
            problem = "scheme: usual_pct must be in [0, 100], smooth and wider in [0, 1]"
            raise ArtifactError(problem, found=shares)
