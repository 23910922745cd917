"""What runs showed is put into the repository, without paths of this machine."""

from pathlib import Path

from PIL import Image

from lab.repository import publish

ROOT = Path(__file__).parents[3]


def test_no_result_names_a_folder_of_this_machine():
    for path in (ROOT / "results").rglob("*.json"):
        assert '"/' not in path.read_text(), path.name


def test_each_picture_is_of_the_stored_results():
    """Each but the drawings, which show no data."""
    for path in (ROOT / "pictures").iterdir():
        if path.suffix == ".svg":
            continue
        with Image.open(path) as picture:
            said = picture.info.get("Source") or picture.info["xmp"].decode()
        assert said == publish.source_of(ROOT / "results" / said.split()[0]), path.name
