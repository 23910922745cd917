"""What is wrong with recordings, and what is done about it."""

import re
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from rover_lib.onboard.errors import EpisodeError

# Faults of pictures that are whole: a policy that learned from them drives badly, and nothing else tells.
SHOW_NOTHING = (
    "frozen_camera|repeated_pictures|unordered_pictures|late_pictures|blank_pictures"
    "|without_colours|swapped_colours|upside_down|covered_lens"
)
HANDLED = {  # what is done about a fault, by its kind
    "repaired": "serial_burst|unsorted_.*_times|stood_unrecorded|scrambled_index|other_units|other_times",
    "read as stopped": "reverse_on_a_car_without",
    "recomputed from the pulses": ".*_recomputed",
    "replaced by the last action": "other_state",
    "taken as recorded": "another_export|another_total|one_sided_steering|no_times|.*_disagrees_with_pulse"
    f"|{SHOW_NOTHING}",
    "left out": ".*",
}
DECISIVE = ("no_formula", "no_car", "no_overlap", "unreadable")  # one is enough to leave a recording out


@dataclass(frozen=True)
class Fault:
    """Something wrong: `kind` happened `count` times in `file` (relative to the root); `note` describes the first."""

    file: str
    kind: str
    count: int
    note: str

    @property
    def handled(self) -> str:
        """What was done about it, one of HANDLED."""
        return next(handled for handled, kinds in HANDLED.items() if re.fullmatch(kinds, self.kind))


@dataclass
class Faults:
    """Counts faults by file and kind, and keeps the note of the first."""

    root: Path
    counted: dict[tuple[str, str], list] = field(default_factory=dict)

    def add(self, path: Path, kind: str, note: str, count: int = 1) -> None:
        if count:
            entry = self.counted.setdefault((relative(path, self.root), kind), [0, note])
            entry[0] += count

    def listed(self) -> tuple[Fault, ...]:
        return tuple(Fault(file, kind, count, note) for (file, kind), (count, note) in sorted(self.counted.items()))

    def nothing_usable(self, what: str, remedy: str) -> EpisodeError:
        """The error of recordings of which all is left out. remedy: if the first reason has none of its own."""
        dropped = [fault for fault in self.listed() if fault.handled == "left out"]
        kinds: Counter[str] = Counter()
        for fault in dropped:
            kinds[fault.kind] += fault.count
        order = sorted(kinds, key=lambda kind: (kind not in DECISIVE, kind == "nothing_usable", -kinds[kind], kind))[:6]
        worst = ", ".join(f"{kind} {kinds[kind]} times" for kind in order)
        note = next((f"{fault.note} ({fault.file})" for fault in dropped if fault.kind == order[0]), "")
        what = f"{self.root}: {what} ({worst or 'empty'})"
        return EpisodeError(what, found=note or None, remedy="" if "; " in note else remedy)


def relative(path: Path, root: Path) -> str:
    """Return a file's path as reports show it: relative to `root`, or only its name if it lies elsewhere."""
    return path.relative_to(root).as_posix() if path.is_relative_to(root) else path.name
