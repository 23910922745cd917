"""Imports go one way, onboard <- workshop <- playground <- emulated; the Pi's part needs nothing of a workstation."""

import ast
import sys
from pathlib import Path

import rover_lib

ROOT = Path(rover_lib.__file__).parent
MAY = {
    "onboard": {"onboard"},
    "workshop": {"onboard", "workshop"},
    "playground": {"onboard", "workshop", "playground"},
    "emulated": {"onboard", "workshop", "playground", "emulated"},
}
ONBOARD_NEEDS = {"torch", "numpy", "cv2", "serial", "yaml", "systemd_watchdog", "rover_lib"}


def imported(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {a.name for a in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found |= {f"{node.module}.{a.name}" for a in node.names}
    return found


def test_imports_go_one_way():
    files = [p for part in MAY for p in (ROOT / part).glob("*.py")]
    assert len(files) > 15
    for path in files:
        for name in imported(path):
            parts = name.split(".")
            if parts[0] == "rover_lib" and len(parts) > 1 and (ROOT / parts[1]).is_dir():
                assert parts[1] in MAY[path.parent.name], f"{path}: imports {name}"
            assert name != "rover_lib.cli" and not name.startswith("rover_lib.cli."), f"{path}: imports the cli"


def test_onboard_needs_only_what_a_pi_has():
    for path in (ROOT / "onboard").glob("*.py"):
        for name in imported(path):
            top = name.split(".")[0]
            assert top in ONBOARD_NEEDS or top in sys.stdlib_module_names, f"{path}: imports {name}"
