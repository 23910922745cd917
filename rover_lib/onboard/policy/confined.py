"""Load artifacts only in a process that has confined itself: whoever made them, they cannot do harm there.

run_confined() starts a process of its own, whose function calls load_confined().
"""

import importlib
import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from rover_lib.onboard.artifact.manifest import Artifact
from rover_lib.onboard.errors import PolicyError, RoverError
from rover_lib.onboard.policy.confine import confine, memory_mb
from rover_lib.onboard.policy.load import Policy, import_engine, load_policy
from rover_lib.onboard.stage import plain


def run_confined(function: Callable[..., Any], *, timeout_s: float | None = None, **arguments: Any) -> Any:
    """Call a function of a module in a new process, and return what it returned there.

    function: calls load_confined(). Arguments and result are of JSON's types: a pickle could run anything here. Raises
    the function's RoverError as a PolicyError, and PolicyError if the process ends otherwise or after timeout_s.
    """
    command = [sys.executable, "-m", __name__, function.__module__, function.__qualname__, json.dumps(plain(arguments))]
    problem = f"the process of {function.__qualname__}"
    try:
        done = subprocess.run(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, timeout=timeout_s)
    except subprocess.TimeoutExpired:
        raise PolicyError(f"{problem} took longer than {timeout_s:g} s") from None
    try:
        result, error = json.loads(done.stdout)
        refused = error and PolicyError(str(error["what"]), found=error["found"], remedy=str(error["remedy"]))
    except (ValueError, LookupError, TypeError):
        raise PolicyError(f"{problem} ended ({done.returncode})", remedy="is there enough memory?") from None
    if refused:
        raise refused
    return result


def load_confined(
    paths: Mapping[str, Path | str], *, threads: int, notify: Callable[[str], object] | None = None
) -> tuple[dict[str, Policy], dict[str, Artifact]]:
    """Give up every right that no inference needs, for good, and load artifacts. Return policies and open artifacts.

    From then on nothing that this process prints is seen: an artifact could write what it likes on a terminal. notify:
    told why, if the process is not confined; None: standard error is.
    """
    artifacts = {name: Artifact(path) for name, path in paths.items()}
    for artifact in artifacts.values():
        import_engine(artifact)
    errors = os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for standard in (1, 2):
        os.dup2(nowhere, standard)
    if reason := confine(sum(memory_mb(path, threads) for path in paths.values())):
        if notify:
            notify(reason)
        else:
            os.write(errors, f"rover: not confined: {reason}\n".encode())
    os.close(errors)
    return {name: load_policy(artifact, threads=threads) for name, artifact in artifacts.items()}, artifacts


def main(module: str, name: str, arguments: str) -> None:
    """Run as the program that run_confined() starts: print the function's result, or its error, as JSON."""
    answers = os.dup(1)
    os.dup2(2, 1)  # whatever else is printed is no answer
    result = None
    refusal = None
    try:
        result = getattr(importlib.import_module(module), name)(**json.loads(arguments))
    except RoverError as error:
        actual = None if error.found is None else str(error.found)
        refusal = {"what": error.what, "found": actual, "remedy": error.remedy}
    with os.fdopen(answers, "w") as file:
        json.dump(plain([result, refusal]), file)


if __name__ == "__main__":
    main(*sys.argv[1:])
