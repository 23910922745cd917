"""Provision a rover with a laptop that dies after one task and then after another, and see that nothing stays undone.

    row = provision_in_pieces(pi, folder=tmp, variables={...})

From nothing, each play is killed right after the first task that changed something and that no earlier play was killed
after (callbacks/cut.py); the next one begins at the beginning. A task that changes nothing leaves the rover as it was,
so these are all the states in which it can be left between two tasks. The play that nobody kills any more has to work,
another one after it must change nothing, and all that a change asks of systemd (handlers) must have been done.
"""

import re
import signal
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import yaml

from lab.pi import playbooks
from lab.pi.container import Container
from lab.pi.emulation import EmulationError
from lab.pi.playbooks import Play

CALLBACKS = Path(__file__).with_name("callbacks")
HANDLERS = playbooks.REPOSITORY / "ansible" / "roles" / "rover" / "handlers" / "main.yml"
ELSEWHERE = {"Restart the view"}  # its last task restarts it too
UNITS = ("rover-drive.service", "rover-view.service")
MOST = 100  # plays, of which a rover without a view takes some 25


def provision_in_pieces(
    pi: Container,
    *,
    folder: Path,
    variables: Mapping[str, Any],
    every: int = 1,
    done: Callable[[Play], None] = lambda play: None,
) -> dict[str, Any]:
    """Provision a rover that has nothing yet, by plays that are killed after every `every`-th task; return a row.

    folder, variables: as for playbooks.run. done: called with each play. The row: cut_after, the tasks that a play was
    killed after; changed_after, how many the last play changed; undone, what nobody asked of systemd; stale, the units
    whose newest file systemd has not read. Raises EmulationError if a play fails that nobody killed.
    """
    seen = folder / "cut"
    seen.write_text("")
    more = {"ANSIBLE_CALLBACK_PLUGINS": str(CALLBACKS), "CUT": str(seen), "CUT_EVERY": str(every)}
    cut_after, ran = [], set()
    for _ in range(MOST):
        play = playbooks.run("provision", [pi], folder=folder, variables=variables, more=more)
        ran |= handlers(play.output)
        done(play)
        if play.code != -signal.SIGKILL:
            break
        cut_after.append(seen.read_text().splitlines()[-1])
    again = playbooks.run("provision", [pi], folder=folder, variables=variables)
    done(again)
    for made in (play, again):
        if not made.ok:
            raise EmulationError(f"provision.yml, killed after {cut_after[-1:]} before, fails: {made.end}")
    return {
        "cut_after": cut_after,
        "changed_after": again.changed,
        "undone": sorted({row["name"] for row in yaml.safe_load(HANDLERS.read_text())} - ELSEWHERE - ran),
        "stale": [unit for unit in UNITS if _is_stale(pi, unit)],
    }


def handlers(output: str) -> set[str]:
    """Return the names of the handlers that a play ran."""
    return set(re.findall(r"^RUNNING HANDLER \[(?:rover : )?(.*?)\] \*", output, re.MULTILINE))


def _is_stale(pi: Container, unit: str) -> bool:
    return "yes" in pi.inside("systemctl", "show", "--property=NeedDaemonReload", unit).stdout
