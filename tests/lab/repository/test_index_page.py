"""What an index and a clone show of the project."""

import subprocess
import tomllib
from pathlib import Path

from lab.repository.index_page import LINK, index_page
from rover_lib.onboard.wheel_version import VERSION

ROOT = Path(__file__).parents[3]
README = (ROOT / "README.md").read_text()


def test_no_link_of_an_index_is_relative():
    alone = index_page(README)
    assert "![" not in alone and not LINK.search(alone) and "(https://github.com/huggingface/lerobot)" in alone
    linked = index_page(README, "https://example.org/rover")
    assert not LINK.search(linked) and linked.count("![") == README.count("![")
    assert "](https://example.org/rover/blob/HEAD/docs/safety.md)" in linked
    assert "](https://example.org/rover/raw/HEAD/pictures/drive.webp)" in linked


def test_every_package_is_typed_and_has_the_one_version():
    whole, plugin = (
        tomllib.loads((ROOT / name / "pyproject.toml").read_text()) for name in (".", "lerobot_robot_rover")
    )
    packages = whole["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]
    assert all((ROOT / name / "py.typed").is_file() for name in (*packages, "lerobot_robot_rover"))
    for project, folder in ((whole, ROOT), (plugin, ROOT / "lerobot_robot_rover")):
        assert "version" in project["project"]["dynamic"]
        assert f'VERSION = "{VERSION}"' in (folder / project["tool"]["hatch"]["version"]["path"]).read_text()
    assert not {"dev", "docs"} & whole["project"]["optional-dependencies"].keys()


def test_what_the_pages_have_people_make_is_not_in_git_status():
    made = ["mine.pth", "best_model.pth", "best_model_curves/loss.png", "best_model_pretrained_model/config.json"]
    made += ["car.yml", "episodes/episode_1/episode_data.json", "runs/drive.log", "wheels/a.whl", "drives/meta"]
    made.append("policy_static.onnx.zip")
    command = ["git", "check-ignore", "--no-index", *made]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.stdout.split() == made
