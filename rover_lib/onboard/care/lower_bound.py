"""The least time that a Raspberry Pi 5 needs for an inference, by arithmetic alone."""

# Measured peaks of a Raspberry Pi 5, four cores at 2.4 GHz (public cpufp results), in 10**9 multiply-accumulates
# per second: INT8 SDOT 614 GOPS, FP16 307 GFLOPS, FP32 153.5 GFLOPS, two operations to a multiply-accumulate.
PI5_GMAC_PER_S = {"int8": 307.0, "fp16": 153.5, "fp32": 76.75}


def floor_ms(gmac: float | None, mode: str) -> float | None:
    """Return the least time that a Pi 5 needs for one inference, by arithmetic alone; None where `gmac` is not known.

    gmac: 10**9 multiply-accumulates of one inference. mode: an artifact's: `mixed` and `dynamic` count as INT8, a floor
    that they cannot reach.
    """
    return None if gmac is None else gmac / PI5_GMAC_PER_S["fp32" if mode == "fp32" else "int8"] * 1000
