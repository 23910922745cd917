"""What is missing is named, with the command that installs it, and installed only by root."""

import os

import pytest

from lab import debian
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


def test_root_installs_them_by_the_newest_lists(monkeypatch):
    asked = []
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    monkeypatch.setattr(debian.shutil, "which", lambda name: f"/usr/bin/{name}")
    monkeypatch.setattr(debian, "run", lambda *command, **options: asked.append(command))
    install_packages([], "nothing")
    assert not asked
    install_packages(["qemu-user"], "counting")
    update, install = asked
    assert update[:2] == ("apt-get", "update") and install[:2] == ("apt-get", "install") and install[-1] == "qemu-user"
