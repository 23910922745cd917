"""A run's copy in JupyterLab, in a real browser: the explorer's slider, and the notebook once it is opened again."""

import re
import shutil
import subprocess
import threading
from contextlib import ExitStack

import pytest
from playwright.sync_api import Page, expect

from tests.helpers.browser import PATIENT_MS, chromium, served_to_a_browser

pytestmark = [pytest.mark.release, chromium]
NAME = "in-a-browser"
ADDRESS = re.compile(r"http://localhost\S+token=\S+")
WITHOUT_MODEL = "Error displaying widget"


def open_notebook(page: Page, address: str) -> None:
    lab, token = address.split("?")
    page.goto(f"{lab.split('/lab')[0]}/lab/tree/01_load.ipynb?{token}")
    page.wait_for_selector(".jp-Notebook .jp-Cell")


def test_the_slider_moves_the_picture_and_a_notebook_opens_again(demo_run):
    words = ["notebooks", demo_run, "--as", NAME]
    with ExitStack() as stack:
        stack.callback(shutil.rmtree, demo_run.parent / NAME)
        lab, browser = stack.enter_context(served_to_a_browser(*words, stderr=subprocess.PIPE))
        address = next(found[0] for line in lab.stderr if (found := ADDRESS.search(line)))
        threading.Thread(target=lab.stderr.read, daemon=True).start()
        page = browser.new_page(viewport={"width": 1400, "height": 1000})
        page.set_default_timeout(PATIENT_MS)
        open_notebook(page, address)
        expect(page.get_by_text(WITHOUT_MODEL)).to_have_count(0)

        expect(page.get_by_text("| Idle")).to_be_visible()  # before, cells that are run stay as they are
        page.get_by_role("menuitem", name="Run").click()
        page.get_by_text("Run All Cells", exact=True).click()
        picture = page.locator(".jupyter-widgets img").first
        picture.scroll_into_view_if_needed()
        before = picture.get_attribute("src")
        expect(page.get_by_text("| Idle")).to_be_visible()
        page.locator(".noUi-handle").first.click()
        page.keyboard.press("ArrowRight")
        expect(picture).not_to_have_attribute("src", before)

        page.keyboard.press("Escape")
        page.keyboard.press("Control+s")
        expect(page.locator(".jp-DirtyIndicator, .jp-mod-dirty")).to_have_count(0)
        open_notebook(page, address)
        expect(page.locator(".jupyter-widgets img").first).to_be_visible()
        expect(page.get_by_text(WITHOUT_MODEL)).to_have_count(0)
