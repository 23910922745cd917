"""What a machine tells about itself: one that tells nothing, and a Raspberry Pi."""

from pathlib import Path

import pytest

from rover_lib.onboard.car.host import throttled_means


def test_what_a_pi_tells(pi_host):
    assert pi_host.reading() == {"temperature_c": 61.35, "clock_mhz": 1500, "throttled": "0x50000"}
    assert pi_host.core_ticks() == [(4, 10), (4, 6)]
    assert pi_host.process_peak_memory_mb() == pytest.approx(409.6)
    (pi_host.sys_root / "class/thermal/thermal_zone0/temp").write_text("hot")
    assert pi_host.temperature_c() == 70.0
    for broken in ("VCHI initialization failed; exit 255", "throttled=0x"):
        Path(pi_host.vcgencmd).write_text(f"#!/bin/sh\necho {broken}\n")
        assert pi_host.throttled() is None
    assert (throttled_means(None), throttled_means("0x0")) == (None, [])
    assert throttled_means("0x80008") == ["soft temperature limit now", "soft temperature limit since the start"]
