"""A connection to this machine that is lost for good, once something with LOST_AT in its name is to go over it."""

import os
from pathlib import Path

from ansible.errors import AnsibleConnectionFailure
from ansible.plugins.connection.local import Connection as Local

DOCUMENTATION = """
name: lost
short_description: this machine, until it is out of reach
description: For tests. In the environment, LOST_AT says when, and LOST is a file that is made then.
author: rover-policy
"""


class Connection(Local):
    """As `local`."""

    transport = "lost"

    def exec_command(self, cmd, in_data=None, sudoable=True):
        self._try(cmd)
        return super().exec_command(cmd, in_data=in_data, sudoable=sudoable)

    def put_file(self, in_path, out_path):
        self._try(in_path)
        super().put_file(in_path, out_path)

    def _try(self, what: object) -> None:
        mark = Path(os.environ["LOST"])
        if os.environ["LOST_AT"] in str(what):
            mark.touch()
        if mark.exists():
            raise AnsibleConnectionFailure("Failed to connect to the host via ssh: no route to it")
