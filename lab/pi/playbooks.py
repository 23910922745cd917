"""Run the playbooks of ansible/ as a human would, on a rover that is given by the port of its sshd."""

import json
import os
import re
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lab.pi.container import Container
from lab.pi.debian_image import USER
from rover_lib.onboard.errors import RoverError

REPOSITORY = Path(__file__).parents[2]
MOST_S = 3600.0
NO_KNOWN_HOSTS = "-o UserKnownHostsFile=/dev/null -o StrictHostKeyChecking=no -o LogLevel=ERROR"


@dataclass(frozen=True)
class Play:
    """What a playbook did."""

    code: int
    output: str

    @property
    def ok(self) -> bool:
        """Whether nothing failed and the rover was reached."""
        return self.code == 0 and self.changed >= 0

    @property
    def changed(self) -> int:
        """How many tasks changed something, by Ansible's last lines; -1 if it did not get that far."""
        found = re.findall(r" : ok=\d+ +changed=(\d+) ", self.output.partition("PLAY RECAP")[2])
        return sum(map(int, found)) if found else -1

    @property
    def end(self) -> str:
        """The end of its output before the recap: the failed task, if one failed."""
        return self.output.partition("PLAY RECAP")[0].strip()[-3000:]


def run(book: str, pi: Container, folder: Path, variables: Mapping[str, Any]) -> Play:
    """Run ansible/<book>.yml on a rover, with variables. A play that fails raises nothing.

    folder: for the inventory and Ansible's own files. Raises RoverError if the play takes longer than MOST_S.
    """
    program = Path(sys.executable).with_name("ansible-playbook")
    (folder / "inventory.ini").write_text(inventory(pi))
    given = {"rover_command": str(program.with_name("rover")), **variables}
    command = [program, "-i", folder / "inventory.ini", REPOSITORY / "ansible" / f"{book}.yml", "-e", json.dumps(given)]
    try:
        how: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
        how |= {"cwd": REPOSITORY, "env": _environment(folder), "errors": "replace", "timeout": MOST_S}
        done = subprocess.run([str(word) for word in command], text=True, **how)
    except subprocess.TimeoutExpired:
        raise RoverError(f"{book}.yml took more than {MOST_S:g} s") from None
    return Play(done.returncode, done.stdout)


def inventory(pi: Container) -> str:
    """Return the repository's inventory.ini with this rover instead of its own."""
    text = (REPOSITORY / "inventory.ini").read_text()
    where = f"ansible_host=127.0.0.1 ansible_port={pi.port} ansible_ssh_private_key_file={pi.key}"
    text = re.sub("(?m)^rover1 .*", f"{pi.name} {where}", text)
    return f"{text}\nansible_user={USER}\nansible_ssh_extra_args={NO_KNOWN_HOSTS}\n"


def _environment(folder: Path) -> dict[str, str]:
    """Return Ansible's environment: without the user's own settings for it, and with its files in the folder."""
    kept = {key: value for key, value in os.environ.items() if not key.startswith("ANSIBLE")}
    own = {"ANSIBLE_HOME": str(folder), "ANSIBLE_NOCOLOR": "1", "ANSIBLE_LOCAL_TEMP": str(folder / "local")}
    own["ANSIBLE_TIMEOUT"] = "120"  # sudo, emulated on a busy machine, took more than the usual 10 s
    return {**kept, **own, "PATH": f"{Path(sys.executable).parent}:{os.environ.get('PATH', '')}"}
