"""Run the playbooks of ansible/ as a human would, on rovers that are given by the ports of their sshd.

play = run("provision", [pi], folder=tmp)
play.ok, play.seconds, play.recap["rover1"]["changed"], play.output
"""

import configparser
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from lab.pi.debian_image import USER
from lab.pi.emulation import EmulationError

REPOSITORY = Path(__file__).parents[2]
INVENTORY = REPOSITORY / "inventory.ini"
COUNTS = ("ok", "changed", "unreachable", "failed", "skipped", "rescued", "ignored")
NO_KNOWN_HOSTS = "-o UserKnownHostsFile=/dev/null -o StrictHostKeyChecking=no -o LogLevel=ERROR"


class Host(Protocol):
    """What the inventory says about a rover: the port of its sshd on the loopback, and the key of its user."""

    @property
    def name(self) -> str: ...
    @property
    def port(self) -> int: ...
    @property
    def key(self) -> Path: ...


@dataclass(frozen=True)
class Play:
    """What a playbook did. recap: Ansible's counts by host, {"rover1": {"ok": 12, "changed": 0, ...}}."""

    book: str
    code: int
    seconds: float
    recap: dict[str, dict[str, int]]
    output: str

    @property
    def ok(self) -> bool:
        """Whether nothing failed and every host was reached."""
        return self.code == 0 and bool(self.recap)

    @property
    def changed(self) -> int:
        """How many tasks changed something, on all hosts together."""
        return sum(row.get("changed", 0) for row in self.recap.values())

    @property
    def recap_lines(self) -> list[str]:
        """Ansible's own last lines."""
        return [line for line in self.output.partition("PLAY RECAP")[2].splitlines()[1:] if line.strip()]

    @property
    def end(self) -> str:
        """The end of its output before the recap: the failed task, if one failed."""
        return self.output.partition("PLAY RECAP")[0].strip()[-3000:]

    def row(self) -> dict[str, Any]:
        """Return this play's row for the report."""
        return {"play": self.book, "ok": self.ok, "seconds": round(self.seconds, 1), "recap": self.recap}


def run(
    book: str,
    hosts: Sequence[Host],
    *,
    folder: Path,
    check: bool = False,
    variables: Mapping[str, Any] | None = None,
    more: Mapping[str, str] | None = None,
    timeout_s: float = 3600,
) -> Play:
    """Run ansible/<book>.yml on hosts, in this order.

    folder: for the inventory and Ansible's own files; plays with the same folder share ssh connections. check: run
    with --check --diff. variables: passed with -e. more: of Ansible's environment. A play that fails raises nothing.
    Raises EmulationError if there is no Ansible, or if the play takes longer than timeout_s.
    """
    program = Path(sys.executable).with_name("ansible-playbook")
    if not program.exists():
        remedy = "pip install -e '.[dev]', or 'make pi-fast'"
        raise EmulationError(f"no {program.name} beside {sys.executable}", remedy=remedy)
    (folder / "inventory.ini").write_text(inventory(hosts))
    given = {"rover_command": str(program.with_name("rover")), **(variables or {})}
    command = [program, "-i", folder / "inventory.ini", REPOSITORY / "ansible" / f"{book}.yml"]
    command += [*(["--check", "--diff"] if check else []), "-e", json.dumps(given)]
    started = time.monotonic()
    with (folder / "output").open("w+b") as output:
        process = subprocess.Popen(
            [str(c) for c in command],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            cwd=REPOSITORY,
            env={**environment(folder), **(more or {})},
            start_new_session=True,
        )
        try:
            code = process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            raise EmulationError(f"{book}.yml took more than {timeout_s:g} s") from None
        finally:
            if process.poll() is None:
                os.killpg(process.pid, 15)
                process.wait()
        output.seek(0)
        text = output.read().decode(errors="replace")
    return Play(book, code, time.monotonic() - started, recap(text), text)


def inventory(hosts: Sequence[Host]) -> str:
    """Return the repository's inventory.ini with these hosts in it."""
    given = configparser.RawConfigParser(allow_no_value=True, delimiters=("=",))
    given.optionxform = str  # type: ignore[assignment,method-assign]  # as its documentation says to keep the case
    given.read(INVENTORY)
    lines = ["[rovers]"]
    for host in hosts:
        where = {"ansible_host": "127.0.0.1", "ansible_port": host.port, "ansible_ssh_private_key_file": host.key}
        lines.append(" ".join([host.name, *(f"{k}={v}" for k, v in where.items())]))
    lines += ["[rovers:vars]", *(f"{k}={v}" for k, v in given["rovers:vars"].items()), f"ansible_user={USER}"]
    lines.append(f"ansible_ssh_extra_args={NO_KNOWN_HOSTS}")
    return "\n".join(lines) + "\n"


def environment(folder: Path) -> dict[str, str]:
    """Return Ansible's environment: without the user's own settings for it, and with its files in the folder."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith("ANSIBLE")}
    own = {"ANSIBLE_HOME": str(folder), "ANSIBLE_NOCOLOR": "1", "ANSIBLE_LOCAL_TEMP": str(folder / "local")}
    own["ANSIBLE_TIMEOUT"] = "120"  # sudo, emulated on a busy machine, took more than the usual 10 s
    return {**kept, **own, "PATH": f"{Path(sys.executable).parent}:{os.environ.get('PATH', '')}"}


def recap(output: str) -> dict[str, dict[str, int]]:
    """Read the counts in Ansible's last lines, by host; empty if it did not get that far."""
    found = {}
    for line in output.partition("PLAY RECAP")[2].splitlines()[1:]:
        name, colon, counts = line.partition(" : ")
        pairs = dict(re.findall(r"(\w+)=(\d+)", counts))
        if colon and set(COUNTS[:4]) <= set(pairs):
            found[name.strip()] = {key: int(pairs.get(key, 0)) for key in COUNTS}
    return found
