"""Where recordings are, and what their user adds to them."""

import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Source:
    """Where recordings are, and what the user adds if the dataset itself does not say it.

    action_names: the names of its actions, in the order of its columns, and of its states too if those are unnamed.
    cameras: the cameras that the policy looks through, in the policy's order. facts: what a policy's files do not say,
    as checkpoint.facts reads it. throttle: "as-recorded" or "negated", for tubs of mostly negative throttles.
    """

    path: Path
    action_names: tuple[str, ...] = ()
    cameras: tuple[str, ...] = ()
    facts: str = ""
    throttle: str = ""

    @classmethod
    def of(
        cls, path: "Path | str | Source", action_names: str = "", camera: str = "", facts: str = "", throttle: str = ""
    ) -> "Source":
        """Make a source from a path and a command line's comma-separated names; a Source is returned unchanged."""
        if isinstance(path, Source):
            return path
        names, cameras = (tuple(n.strip() for n in text.split(",") if n.strip()) for text in (action_names, camera))
        return cls(Path(path), names, cameras, facts, throttle)

    def typed(self) -> str:
        """What a user types for it."""
        by_option = {"--action-names": self.action_names, "--camera": self.cameras, "--throttle": (self.throttle,)}
        words = [str(self.path)]
        for option, values in by_option.items():
            words += [option, ",".join(values)] if any(values) else []
        return shlex.join(words)

    @classmethod
    def loaded(cls, given: Mapping[str, Any], elsewhere: Path | str | None = None) -> "Source":
        """The recordings that a run loaded, by load.json's params, or those `elsewhere`, with the same names."""
        values = (given.get(name, "") for name in ("action_names", "camera", "facts", "throttle"))
        return cls.of(elsewhere or given["episodes"], *values)
