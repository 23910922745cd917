"""The laboratory, which proves what the project claims. PARAMS: its gates and limits, the content of params.yml."""

from pathlib import Path

from rover_lib.onboard.params import read_params

PARAMS = read_params(Path(__file__).with_name("params.yml"))
