"""Imports go one way: tests/imports.toml says which. And the rover's part needs only what a rover has."""

import ast
import subprocess
import sys
import tomllib
from pathlib import Path

import grimp

ROOT = Path(__file__).parents[1]
LINTER = tomllib.loads((ROOT / "tests" / "imports.toml").read_text())["tool"]["importlinter"]
# aiohttp is of the extra `view`.
ONBOARD_NEEDS = {"torch", "onnxruntime", "numpy", "cv2", "simplejpeg", "filelock", "serial", "yaml"}
ONBOARD_NEEDS |= {"systemd_watchdog", "click", "aiohttp", "rover_lib"}


def test_imports_go_one_way_and_in_no_circle():
    """Imports inside functions and only for type checkers count too."""
    command = [Path(sys.executable).with_name("lint-imports"), "--no-cache", "tests/imports.toml"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_every_room_has_a_place_and_says_its_subject():
    for house in (contract for contract in LINTER["contracts"] if "containers" in contract):
        folder = ROOT / house["containers"][0].replace(".", "/")
        assert {p.parent.name for p in folder.glob("*/__init__.py")} <= {*house["layers"]}, "a room that has no place"
    for top in {*LINTER["root_packages"]} - {"lerobot_robot_rover", "lab"}:
        for file in (ROOT / top).rglob("__init__.py"):
            assert ast.get_docstring(ast.parse(file.read_text())), file


def test_onboard_needs_only_what_a_rover_has():
    imports = grimp.build_graph("rover_lib", include_external_packages=True, cache_dir=None)
    for module in imports.find_descendants("rover_lib.onboard"):
        for name in imports.find_modules_directly_imported_by(module):
            top = name.split(".")[0]
            assert top != "aiohttp" or module.endswith(".server"), f"{module}: imports {name}"
            assert top in ONBOARD_NEEDS or top in sys.stdlib_module_names, f"{module}: imports {name}"
