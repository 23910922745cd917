"""Recognise what owners of other cars and robots bring in place of our recordings, so that it is called what it is."""

import re
from itertools import islice
from pathlib import Path

from rover_lib.onboard.kinds import kinds_of

READ = "only folders of episodes, LeRobotDatasets and donkeycar tubs are read: write a LeRobotDataset of it"
TABLE = Path(__file__).with_suffix(".txt")  # what a file's path looks like, what its folder then is, and what to do
MOST_FILES = 2000


def name_stranger(root: Path) -> tuple[str, str] | None:
    """Return what a folder without episodes holds, and what to do; None for what is not known."""
    inside = [p for p in sorted(root.iterdir()) if p.is_dir() and not p.name.startswith(".")]
    for kind, words, remedy in (
        ("tub", "donkeycar tubs", "rover export-dataset {} OUT, and so for each"),
        ("dataset", "LeRobotDatasets", "give one of them, such as {}"),
        ("recordings", "folders of recordings", "give one of them, such as {}"),
    ):
        if found := [folder for folder in inside if kind in kinds_of(folder)]:
            return f"a folder of {len(found)} {words}", remedy.format(found[0])
    paths = [f"/{path.relative_to(root).as_posix()}" for path in islice(root.rglob("*"), MOST_FILES)]
    for line in TABLE.read_text().splitlines():
        pattern, words, *own = line.split("\t")
        if any(re.search(pattern, path) for path in paths):
            return words, own[0] if own else READ
    return None
