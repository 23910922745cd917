"""What runs showed is put into the repository, without paths of this machine."""

from pathlib import Path

import nbformat
import pytest
from PIL import Image

from lab.repository import publish
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.stage import write_stage

ROOT = Path(__file__).parents[3]


def cell(source, *outputs, tags=()):
    made = nbformat.v4.new_code_cell(source, outputs=list(outputs), metadata={"tags": list(tags)})
    made.id = tags[0] if tags else "work"
    return made


def notebook(*cells):
    return nbformat.v4.new_notebook(cells=list(cells))


def stream(text, name="stdout"):
    return nbformat.v4.new_output("stream", name=name, text=text)


def test_outputs_come_without_counts_and_noise():
    shown = nbformat.v4.new_output("execute_result", data={"text/plain": "1"}, execution_count=3)
    stored = notebook(cell("a = 1", tags=("parameters",)), cell("a"))
    ran = notebook(cell("a = 2", tags=("parameters",)), cell("a", stream("1"), stream("noise", "stderr"), shown))
    parameters, work = nbformat.reads(publish.with_outputs(stored, ran, "01"), as_version=4).cells
    assert parameters.source == "a = 1"
    assert [output.output_type for output in work.outputs] == ["stream", "execute_result"]
    assert work.outputs[1].execution_count is None
    with pytest.raises(RoverError, match="not what was executed"):
        publish.with_outputs(stored, notebook(cell("b")), "01")


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
