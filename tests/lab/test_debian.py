"""What is missing is named, with the command that installs it, and never installed without root."""

import os

import pytest

from lab.debian import install_packages, missing_packages
from rover_lib.onboard.errors import RoverError


def test_commands_and_files_tell_what_is_missing(tmp_path, monkeypatch):
    header = tmp_path / "some.h"
    header.touch()
    (tmp_path / "there").touch()
    monkeypatch.setenv("PATH", str(tmp_path))
    needs = {"no-b": "b", "no-a": "a", "no-a2": "a", "there": "c", str(header): "d", f"{header}pp": "e"}
    assert missing_packages(needs) == ["a", "b", "e"]


def test_packages_are_named_when_they_cannot_be_installed(monkeypatch):
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    with pytest.raises(RoverError) as raised:
        install_packages(["qemu-user", "gcc"], "counting")
    assert raised.value.remedy.startswith("sudo apt-get install ") and raised.value.remedy.endswith(" qemu-user gcc")
