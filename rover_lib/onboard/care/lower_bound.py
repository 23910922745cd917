"""The least time that a Raspberry Pi 5 needs for an inference, by arithmetic alone."""

from rover_lib.onboard.checked import is_number
from rover_lib.onboard.errors import ParamsError

# Measured peaks of a Raspberry Pi 5, four cores at 2.4 GHz (public cpufp results), in 10**9 multiply-accumulates
# per second: INT8 SDOT 614 GOPS, FP16 307 GFLOPS, FP32 153.5 GFLOPS, two operations to a multiply-accumulate.
PI5_GMAC_PER_S = {"int8": 307.0, "fp16": 153.5, "fp32": 76.75}
PRECISION = {"dynamic": "int8", "static": "int8", "mixed": "int8"}  # of an artifact's mode, at its best


def floor_ms(gmac: float | None, mode: str) -> float | None:
    """Return the least time that a Pi 5 needs for one inference, by arithmetic alone; None where `gmac` is not known.

    gmac: 10**9 multiply-accumulates of one inference. mode: a precision (int8, fp16, fp32), or an artifact's mode:
    `mixed` and `dynamic` count as INT8, a floor that they cannot reach. Raises ParamsError for another mode or amount.
    """
    if gmac is None:
        return None
    per_s = PI5_GMAC_PER_S.get(PRECISION.get(mode, mode))
    if per_s is None or not is_number(gmac, 0):
        raise ParamsError("a floor needs a known mode, and gmac from 0", found=f"{mode!r} and {gmac!r}")
    return gmac / per_s * 1000
