"""Recognise what owners of other cars and robots bring in place of our recordings, so that it is called what it is."""

import re
from itertools import islice
from pathlib import Path

from rover_lib.onboard.kinds import CALLED, kinds_of

READ = "only folders of episodes, LeRobotDatasets and donkeycar tubs are read: write a LeRobotDataset of it"
TABLE = Path(__file__).with_suffix(".txt")  # what a file's path looks like, what its folder then is, and what to do
MOST_FILES = 2000
DEEPEST = 5  # folders in folders that are looked into


def name_stranger(root: Path) -> tuple[str, str] | None:
    """Return what a file, or a folder without episodes, holds, and what to do; None for what is not known."""
    for above in root.resolve().parents[:3]:
        if kinds := {"dataset", "tub"} & {*kinds_of(above)}:
            return f"a part of {CALLED[kinds.pop()]}", f"give the whole: {above}"
    for depth in range(1, DEEPEST):
        inside = islice(root.glob("*/" * depth), MOST_FILES)
        folders = sorted(p for p in inside if p.is_dir() and not any(n.startswith(".") for n in p.parts[-depth:]))
        for kind, words, remedy in (
            ("tub", "donkeycar tubs", "give one of them, such as {}"),
            ("dataset", "LeRobotDatasets", "give one of them, such as {}"),
            ("recordings", "folders of recordings", "give one of them, such as {}"),
            ("pretrained", "LeRobot checkpoints", "they hold no drives: give recordings, {} as the checkpoint"),
        ):
            if of_kind := [folder for folder in folders if kind in kinds_of(folder)]:
                return f"a folder of {len(of_kind)} {words}", remedy.format(of_kind[0])
    files = [root] if root.is_file() else islice(root.rglob("*"), MOST_FILES)
    paths = [f"/{path.relative_to(root.parent).as_posix()}" for path in files]
    for line in TABLE.read_text().splitlines():
        pattern, words, *own = line.split("\t")
        if any(re.search(pattern, path, re.IGNORECASE) for path in paths):
            return words, own[0] if own else READ
    return None
