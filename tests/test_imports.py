"""Imports go one way: the rover's part needs nothing from the workstation's, and nothing needs the laboratory."""

import ast
import functools
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
# The lowest first:
BESIDE = ("rover_exchange", "rover_learn", "balloon_world")
FLOORS = ("rover_lib.onboard", "rover_lib.workshop", "rover_lib.cli", *BESIDE, "lab")
PLUGIN = "lerobot_robot_rover"  # for LeRobot's commands
TOPS = ("rover_lib", *BESIDE, PLUGIN, "lab")
ROOMS = {
    "lab": ("debian", "arduino", "driving", "a76", "pi", "repository", "__main__"),
    "rover_lib.onboard": ("car", "artifact", "policy", "recording", "drive", "view", "care", "cli"),
    "rover_lib.workshop": ("recordings", "checkpoint", "judge", "int8", "plots", "run"),
}
# hailo_platform is one of Hailo's own packages, which a Pi with its card has; aiohttp is of the extra `view`.
ONBOARD_NEEDS = {"torch", "onnxruntime", "hailo_platform", "numpy", "cv2", "simplejpeg", "filelock", "serial", "yaml"}
ONBOARD_NEEDS |= {"systemd_watchdog", "click", "aiohttp", "rover_lib"}


@functools.cache
def modules() -> dict[str, Path]:
    files = [p for top in TOPS for p in (ROOT / top).rglob("*.py") if "guest" not in p.parts]
    return {".".join(p.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): p for p in files}


@functools.cache
def imported(path: Path) -> set[str]:
    """Return every name that a file imports, also inside functions and only for type checkers."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {a.name for a in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names |= {f"{node.module}.{a.name}" for a in node.names}
    return names


def ours(path: Path) -> set[str]:
    """Return the modules of this repository that a file imports."""
    known = modules()
    names = imported(path)
    return {n if n in known else n.rpartition(".")[0] for n in names if n.split(".")[0] in TOPS}


def place(name: str, places: tuple[str, ...]) -> int | None:
    return next((i for i, p in enumerate(places) if name == p or name.startswith(f"{p}.")), None)


def check_one_way(places: tuple[str, ...]) -> None:
    checked = 0
    for name, path in modules().items():
        if (mine := place(name, places)) is None:
            continue
        for other in ours(path):
            theirs = place(other, places)
            assert theirs is None or theirs <= mine, f"{name} imports {other}"
            checked += 1
    assert checked > 20


def test_imports_go_one_way():
    check_one_way(FLOORS)


@pytest.mark.parametrize("house", ROOMS)
def test_rooms_import_one_way(house):
    """So no two rooms import each other. What stands on the ground, beside the rooms, belongs to none."""
    check_one_way(tuple(f"{house}.{room}" for room in ROOMS[house]))
    there = {p.parent.name for p in (ROOT / house.replace(".", "/")).glob("*/__init__.py")}
    assert there <= set(ROOMS[house]), "a room that nobody has placed"


def test_every_room_says_its_subject():
    folders = {p.parent for top in ("rover_lib", *BESIDE) for p in (ROOT / top).rglob("*.py")}
    for folder in folders:
        assert ast.get_docstring(ast.parse((folder / "__init__.py").read_text())), folder


def test_no_module_imports_itself_in_a_circle():
    """Imports inside functions and only for type checkers count too."""
    arrows = {name: ours(path) for name, path in modules().items()}
    while leaves := [n for n, targets in arrows.items() if not targets & arrows.keys() - {n}]:
        for leaf in leaves:
            del arrows[leaf]
    assert not arrows, f"these import each other: {sorted(arrows)}"


def test_onboard_needs_only_what_a_rover_has():
    for path in (ROOT / "rover_lib" / "onboard").rglob("*.py"):
        for name in imported(path):
            top = name.split(".")[0]
            assert top != "aiohttp" or path.name == "server.py", f"{path}: imports {name}"
            assert top in ONBOARD_NEEDS or top in sys.stdlib_module_names, f"{path}: imports {name}"


def test_the_plugin_for_lerobot_stands_on_onboard_alone():
    """It is installed next to a rover's wheel and LeRobot; no other package of ours needs it."""
    for name, path in modules().items():
        for other in ours(path):
            if name.split(".")[0] == PLUGIN:
                assert other.startswith((PLUGIN, "rover_lib.onboard")), f"{name} imports {other}"
            else:
                assert not other.startswith(PLUGIN), f"{name} imports {other}"
