"""Run one artifact inside the emulated Pi, with rover_lib.onboard alone, as a Pi would run it.

    predict.py ARTIFACT OBSERVATIONS FOLDER COUNTED

inferences.py explains what it reads, counts, prints and leaves in FOLDER. Preparing a frame is counted too.
"""

import sys
from importlib.metadata import version

from inferences import leave, loaded, predict_all

from rover_lib.onboard import load_policy
from rover_lib.onboard.artifact.engines import PACKAGES
from rover_lib.onboard.errors import RoverError


def main(artifact: str, observations: str, folder: str, counted: str) -> None:
    policy = loaded(lambda: load_policy(artifact, threads=1))
    predict_all(policy.predict_chunk, observations, folder, int(counted))
    package = PACKAGES[policy.manifest["engine"]]
    leave(folder, policy.threads, **{package: version(package)})


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except RoverError as e:
        sys.exit(f"error: {e}")
