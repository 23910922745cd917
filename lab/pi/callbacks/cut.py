"""Kills Ansible right after a task that changed something, as a laptop does whose battery is empty."""

import os
import signal
from pathlib import Path

from ansible.plugins.callback import CallbackBase  # type: ignore[import-untyped]

DOCUMENTATION = """
name: cut
type: notification
short_description: kills a play after a task that no play was killed after
description: CUT in the environment is a file with the names of such tasks, CUT_EVERY after which of them it kills.
author: rover-policy
"""


class CallbackModule(CallbackBase):
    """Adds each task that changed something to the file; after every CUT_EVERY-th of them, it kills."""

    CALLBACK_VERSION, CALLBACK_TYPE, CALLBACK_NAME = 2.0, "notification", "cut"

    def v2_runner_on_ok(self, result):
        file = Path(os.environ["CUT"])
        seen, name = file.read_text().splitlines(), result._task.get_name()
        if not result.is_changed() or name in seen:
            return
        file.write_text("\n".join([*seen, name]))
        if len(seen) % int(os.environ["CUT_EVERY"]) == 0:
            os.kill(os.getpid(), signal.SIGKILL)
