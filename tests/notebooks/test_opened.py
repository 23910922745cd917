"""What JupyterLab's server does, by its own contents manager, with a notebook that was opened and saved."""

import shutil

import pytest
from jupyter_server.services.contents.largefilemanager import LargeFileManager
from traitlets.config.loader import PyFileConfigLoader

from rover_lib.workshop.run.run import JUPYTER, NOTEBOOKS

KERNEL = {"kernelspec": {"display_name": "Python 3 (ipykernel)", "language": "python", "name": "python3"}}
WIDGETS = {"version_major": 2, "version_minor": 0}
KIND = "application/vnd.jupyter.widget-state+json"


@pytest.fixture
def server(tmp_path):
    config = PyFileConfigLoader("jupyter_server_config.py", str(JUPYTER)).load_config()
    return LargeFileManager(root_dir=str(tmp_path), config=config)


def save(server, name, **metadata):
    model = server.get(name, content=True)
    model["content"]["metadata"] |= metadata
    server.save(model, name)


@pytest.mark.parametrize("source", sorted(NOTEBOOKS.glob("*.ipynb")), ids=lambda path: path.stem)
def test_a_notebook_that_was_only_opened_stays_as_it_is(server, tmp_path, source):
    shutil.copy(source, tmp_path)
    opened = KERNEL | {"language_info": {"name": "python", "version": "3.13.1"}}
    save(server, source.name, **opened, widgets={KIND: WIDGETS | {"state": {}}})
    assert (tmp_path / source.name).read_bytes() == source.read_bytes()


def test_widgets_that_there_are_and_what_a_new_notebook_says_are_kept(server):
    name = server.new_untitled(type="notebook")["path"]
    widgets = {KIND: WIDGETS | {"state": {"slider": {}}}}
    save(server, name, **KERNEL, widgets=widgets)
    assert server.get(name, content=True)["content"]["metadata"] == KERNEL | {"widgets": widgets}
