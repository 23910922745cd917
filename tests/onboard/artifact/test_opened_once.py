"""An artifact is opened once a command, and what was read of it is carried on."""

import zipfile
from collections import Counter
from pathlib import Path

import pytest
from click.testing import CliRunner

from rover_lib.cli import main
from rover_lib.onboard.policy.load import load_policy


@pytest.fixture
def opens(monkeypatch):
    """How often each file has been opened as a zip, by its name."""
    opened: Counter[str] = Counter()
    whole = zipfile.ZipFile.__init__

    def counted(self, file, *args, **options):
        if isinstance(file, (str, Path)) and "policy" in Path(file).name:
            opened[Path(file).name] += 1
        whole(self, file, *args, **options)

    monkeypatch.setattr(zipfile.ZipFile, "__init__", counted)
    return opened


def test_a_command_opens_it_once(artifacts, opens):
    result = CliRunner().invoke(main, ["inspect", str(artifacts["static"]), "--json"])
    assert result.exit_code == 0 and opens == {"policy_static.pt": 1}, result.output


def test_loading_opens_it_once(artifacts, onnx_static, opens):
    load_policy(artifacts["static"])
    load_policy(onnx_static)
    assert opens == {artifacts["static"].name: 1, onnx_static.name: 1}
