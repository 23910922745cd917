"""`rover view` as a user sees it, in a real browser of a phone's size: its pictures, its buttons, a lost connection."""

import re
import signal
import subprocess

import pytest

pytest.importorskip("aiohttp", reason="needs the extra look")

from playwright.sync_api import expect

from tests.helpers.browser import chromium, served_to_a_browser

pytestmark = [pytest.mark.slow, chromium]
PHONE = {"viewport": {"width": 390, "height": 844}, "device_scale_factor": 2, "is_mobile": True}


def test_a_simulation_on_a_phone(demo_run):
    """What `make watch` shows, by the page's own Content-Security-Policy."""
    words = ["view", demo_run / "policy_static.pt", "--web-port", "0"]
    with served_to_a_browser(*words, stdout=subprocess.PIPE) as (shown, browser):
        page = browser.new_page(**PHONE)
        page.goto(shown.stdout.readline().strip())
        phase, said = page.locator("#phase"), page.locator("#missing")
        expect(page.get_by_role("button", name=re.compile(r"^INT8, undisturbed: hit \d+ of [1-9]"))).to_be_visible()
        boxes = [element.bounding_box() for element in page.locator("body *:visible").all()]
        assert len(boxes) > 20 and all(box["x"] >= -1 and box["x"] + box["width"] <= 391 for box in boxes)
        page.get_by_role("button", name="FP32").click()
        expect(page.get_by_role("button", name="FP32")).to_have_class("on")
        page.get_by_role("button", name="STOP").click()
        expect(said).to_have_text(re.compile("^stopped here"))
        expect(phase).to_have_text("ended")
        page.get_by_role("button", name="next world").click()
        expect(phase).to_have_text("driving")
        page.keyboard.press("ArrowLeft")
        expect(page.locator("#hint")).to_contain_text("Pushed: hit")
        shown.send_signal(signal.SIGINT)
        expect(phase).to_contain_text("no news for")
        page.get_by_role("button", name="STOP").click()
        expect(page.locator("#answer")).to_have_text("NO CONNECTION: stop the car with the transmitter")
