"""What the firmware's pulses say."""

NEUTRAL = (1456, 120)
CAP_US = 238


def throttles(pins):
    return [throttle_us for _, throttle_us in pins]


def moved_after_ms(pins):
    """How long the throttle was above neutral."""
    return max((n + 1 for n, us in enumerate(throttles(pins)) if us > 120), default=0)
