"""Missing Debian packages are named, and installed only if the user asks for that."""

import pytest

from lab import debian
from rover_lib.onboard.errors import RoverError


def test_root_installs_nothing_unasked(monkeypatch):
    started = []
    monkeypatch.setattr(debian, "run", lambda *command, **options: started.append(command))
    monkeypatch.setattr(debian.os, "geteuid", lambda: 0)
    monkeypatch.setattr(debian.shutil, "which", lambda name: f"/usr/bin/{name}")
    monkeypatch.delenv(debian.INSTALL, raising=False)
    with pytest.raises(RoverError, match=r"sudo apt-get install .* gcc-avr, or as root python -m lab --install"):
        debian.install_packages(["gcc-avr"], "the emulated Arduino")
    assert started == []
    monkeypatch.setenv(debian.INSTALL, "1")
    debian.install_packages(["gcc-avr"], "the emulated Arduino")
    assert started[1][-1] == "gcc-avr"
