"""The least time that a Raspberry Pi 5 needs for an inference, by arithmetic alone."""

from collections.abc import Mapping

from rover_lib.onboard.checked import is_number
from rover_lib.onboard.errors import ParamsError

# Measured peaks of a Raspberry Pi 5, four cores at 2.4 GHz (public cpufp results), in 10**9 multiply-accumulates
# per second: INT8 SDOT 614 GOPS, FP16 307 GFLOPS, FP32 153.5 GFLOPS, two operations to a multiply-accumulate.
PI5_GMAC_PER_S = {"int8": 307.0, "fp16": 153.5, "fp32": 76.75}
PRECISION = {"dynamic": "int8", "static": "int8", "mixed": "int8"}  # of an artifact's mode, at its best


def floor_ms(gmac: float | Mapping[str, float] | None, mode: str) -> float | None:
    """The least time that a Pi 5 needs for one inference, by arithmetic alone; None where `gmac` is not
    known.

    gmac: 10**9 multiply-accumulates of one inference, or a mapping from precision (int8, fp16, fp32) to its
    share. mode: a precision, or an artifact's mode, for which a plain number counts as if all of it were in
    INT8 (fp32: in FP32). That is a true floor for `mixed` and `dynamic` too, though one that they cannot
    reach. Raises ParamsError for an unknown mode or a count that is no amount.
    """
    if gmac is None:
        return None
    shares = gmac if isinstance(gmac, Mapping) else {PRECISION.get(mode, mode): gmac}
    total_s = 0.0
    for precision, amount in shares.items():
        if precision not in PI5_GMAC_PER_S:
            known = sorted({*PI5_GMAC_PER_S, *PRECISION})
            raise ParamsError(f"no Pi 5 peak is known for {precision!r}", remedy=f"choose one of {', '.join(known)}")
        if not is_number(amount, 0):
            raise ParamsError("gmac must be a number from 0", found=repr(amount), remedy="count the model again")
        total_s += amount / PI5_GMAC_PER_S[precision]
    return total_s * 1000
