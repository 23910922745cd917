"""What runs showed is put into the repository, without paths of this machine."""

from pathlib import Path

from PIL import Image

from lab.repository import publish
from rover_lib.onboard.stage import write_stage

ROOT = Path(__file__).parents[3]


def test_a_result_has_names_few_digits_and_one_hash_of_many(tmp_path):
    inputs = {f"{i}.jpg": "0" * 64 for i in range(1000)}
    given = {"checkpoint": tmp_path / "best_model.pth"}
    write_stage(tmp_path / "load.json", "load", params=given, metrics={"mae": [1 / 3]}, inputs=inputs)
    text = publish.result(tmp_path / "load.json")
    assert '"best_model.pth"' in text and "0.333333\n" in text and '"1000 files"' in text


def test_each_picture_is_of_the_stored_results():
    """Each but the drawings, which show no data."""
    for path in (ROOT / "pictures").iterdir():
        if path.suffix == ".svg":
            continue
        with Image.open(path) as picture:
            said = picture.info.get("Source") or picture.info["xmp"].decode()
        assert said == publish.source_of(ROOT / "results" / said.split()[0]), path.name
