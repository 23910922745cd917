"""The check before a drive and its ritual, as docs/first_hour.md has a newcomer type them."""

import needs
import pytest

from lab.arduino.rehearsal import rehearse


@pytest.mark.emulated
@needs.simavr
def test_a_script_goes_through_the_ritual_with_the_real_firmware(artifacts):
    asked = []
    verdicts = {check.name: check for check in rehearse(artifacts["static"], asked.append)}
    assert {"camera", "Arduino", "artifact", "inference"} <= set(verdicts)
    for name in ("transmitter", "arming", "failsafe"):
        assert verdicts[name].verdict == "ok", str(verdicts[name])
    assert "sends no pulses" in verdicts["failsafe"].found and len(asked) == 4
