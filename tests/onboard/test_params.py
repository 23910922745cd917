"""Parameters: the rover's defaults, and what a user has set in their place."""

import pytest

from lab import PARAMS
from rover_lib.onboard import params as p
from rover_lib.onboard.errors import ParamsError


def test_a_users_values_stand_over_the_defaults(tmp_path, monkeypatch):
    defaults = p.read_params(p.DEFAULTS)
    (tmp_path / "params.yml").write_text("drive: {fade_s: 0.3}\ngates: {hits_lost: 1}\n")
    monkeypatch.setattr(p, "PLACES", (tmp_path / "none.yml", tmp_path / "params.yml"))
    found = p.params()
    assert found["drive"] == {**defaults["drive"], "fade_s": 0.3}
    assert found["gates"] == {**defaults["gates"], "hits_lost": 1} and found["flight_log"] == defaults["flight_log"]
    monkeypatch.setattr(p, "PLACES", ())
    assert p.params() == defaults


# PyYAML would take the last of a key that stands twice.
@pytest.mark.parametrize("text", [b"drive: 5", b"- 1", b"{", b"drive: {fade_s: 0.3, fade_s: 0.4}", b"# K\xf6nig"])
def test_what_is_no_params_file(tmp_path, monkeypatch, text):
    (tmp_path / "params.yml").write_bytes(text)
    monkeypatch.setattr(p, "PLACES", (tmp_path / "params.yml",))
    with pytest.raises(ParamsError):
        p.params()


def test_each_parameter_stands_in_one_file():
    user, rover, lab = (p.read_params(p.PLACES[0]), p.read_params(p.DEFAULTS), PARAMS)
    assert set(user) & set(rover) == {"gates"} and not set(user["gates"]) & set(rover["gates"])
    assert not set(lab) & (set(user) | set(rover))
