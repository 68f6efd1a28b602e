"""The page in a real browser: Debian's Chromium, alone for a smoke test, and driven by Playwright for the others."""

from __future__ import annotations

import shutil
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest
import uvicorn
from view_world import SCRIPT

from anytouch_jax.encoder.encoder import load_encoder
from anytouch_jax.view import server
from anytouch_jax.view.live import Live

CHROMIUM = shutil.which("chromium")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium: apt-get install chromium")


@contextmanager
def serving(sources: list) -> Iterator[str]:
    """Serve the page of `sources` by a thread, and give its address."""
    running = uvicorn.Server(uvicorn.Config(server.app(sources), port=0, log_level="error", lifespan="off"))
    thread = threading.Thread(target=running.run, daemon=True)
    thread.start()
    while not running.started:
        time.sleep(0.01)
    yield f"http://127.0.0.1:{running.servers[0].sockets[0].getsockname()[1]}/"
    running.should_exit = running.force_exit = True
    thread.join(10)


def test_chromium_shows_the_page(touches, features, tmp_path):
    command = [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path}", "--dump-dom"]
    with serving(server.open_sources([touches, features])) as address:
        command += ["--virtual-time-budget=10000", address]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    assert "features: features.npz" in done.stdout and "of 2 touches" in done.stdout


@pytest.fixture(scope="module")
def address(touches, features, film, tiny_run) -> Iterator[str]:
    """The page of touches, features and a film in the place of a camera."""
    live = Live(str(film), load_encoder(tiny_run), sensor="digit", log=lambda _: None)
    live.start()
    with serving([*server.open_sources([touches, features]), live]) as place:
        yield place
        live.stop()


@pytest.fixture
def browse(address) -> Iterator[Callable[..., object]]:
    """browse(tab, width): the page at a tab. In the end nothing may be in the console of any of them."""
    playwright = pytest.importorskip("playwright.sync_api")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        faults: list[str] = []

        def opened(tab: int, width: int = 1200):
            page = browser.new_page(viewport={"width": width, "height": 800})
            page.on("console", lambda message: faults.append(message.text))
            page.on("pageerror", lambda error: faults.append(str(error)))
            page.on("dialog", lambda dialog: faults.append(f"dialog {dialog.message}"))
            page.goto(address)
            page.locator("nav button").nth(tab).click()
            return page

        yield opened
        browser.close()
        assert faults == []


def until(page, expression: str, argument: object = None) -> None:
    """Wait until a JavaScript expression is true. The page's policy forbids eval, which Playwright's own wait needs."""
    end = time.monotonic() + 60
    while not page.evaluate(expression, argument):
        assert time.monotonic() < end, expression
        page.wait_for_timeout(50)


def drawn(page, selector: str = ".panels canvas") -> str:
    """What a canvas shows, once it is not empty."""
    until(page, "s => document.querySelector(s)?.width === 48", selector)
    return page.locator(selector).first.evaluate("canvas => canvas.toDataURL()")


@pytest.mark.slow
def test_touches_are_filtered_and_played(browse):
    page = browse(0)
    page.wait_for_selector("text=of 2 touches")
    assert page.locator("section h2").all_inner_texts() == ["digit", "gelsight_mini"]
    before = drawn(page)
    page.locator("button", has_text="Play").click()
    until(page, "document.querySelector('input[type=range]').value === '2'")
    page.wait_for_selector("button:has-text('Play')")
    assert drawn(page) != before
    page.get_by_role("combobox", name="split", exact=True).select_option("test")
    page.wait_for_selector("text=of 1 touches")
    assert page.get_by_text(SCRIPT).count() >= 2 and page.title() == "anytouch view"  # text, and no more
    page.get_by_role("combobox", name="sensor", exact=True).select_option("digit")
    until(page, "document.querySelectorAll('section').length === 1")


@pytest.mark.slow
def test_keyboard_alone(browse):
    page = browse(0)
    page.wait_for_selector("text=of 2 touches")
    number = page.locator("input[type=number]")
    page.keyboard.press("ArrowRight")
    until(page, "document.querySelector('input[type=number]').value === '2'")
    page.keyboard.press("ArrowLeft")
    until(page, "document.querySelector('input[type=number]').value === '1'")
    page.keyboard.press(".")
    until(page, "document.querySelector('input[type=range]').value === '1'")
    page.keyboard.press("Space")
    until(page, "document.querySelector('input[type=range]').value === '2'")
    page.keyboard.press("f")  # to the filters: the first is the sensor
    page.keyboard.press("ArrowDown")
    until(page, "document.querySelectorAll('section').length === 1")
    assert number.input_value() == "1"
    for _ in range(30):  # Tab reaches everything, and what has the focus can be seen
        page.keyboard.press("Tab")
        if page.evaluate("document.activeElement.textContent") == "Next →":
            break
    assert page.evaluate("getComputedStyle(document.activeElement).outlineStyle") != "none"
    page.keyboard.press("Enter")
    until(page, "document.querySelector('input[type=number]').value === '2'")


@pytest.mark.slow
def test_a_point_of_the_map_shows_its_neighbours(browse):
    page = browse(1)
    page.wait_for_selector(".legend >> text=gelsight_mini")
    page.locator("canvas.map").click()
    page.wait_for_selector("text=nearest, of other sensors")
    assert 1 <= page.locator(".thumbs figure").count() <= 10
    assert drawn(page)
    shown = {page.locator("h2").first.inner_text()}
    for key in ("ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown"):  # a neighbour lies on one side at least
        page.locator("canvas.map").press(key)
        page.wait_for_timeout(500)
        shown.add(page.locator("h2").first.inner_text())
    assert len(shown) > 1
    page.get_by_role("combobox", name="map", exact=True).select_option("tsne")
    page.wait_for_selector("text=12 features")
    page.locator(".thumbs button").first.click()
    page.wait_for_selector("text=of 2 touches")


@pytest.mark.slow
def test_live_touch_of_a_film(browse):
    page = browse(2)
    until(page, "Number(document.getElementById('main').dataset.frames) > 15")
    page.keyboard.press("b")
    until(page, "!document.querySelector('.fact b').textContent.includes('background')")
    until(page, "[...document.querySelectorAll('.panels figure')].every(figure => !figure.hidden)")
    page.get_by_role("combobox", name="rotate", exact=True).select_option("90")
    page.wait_for_selector("text=capture a background")
    assert page.get_by_role("button", name="Record").is_disabled()  # no folder was named
    page.locator("nav button").nth(0).click()
    page.wait_for_selector("text=of 2 touches")


@pytest.mark.slow
def test_a_narrow_screen(browse):
    for tab, sign in enumerate(("of 2 touches", "Click a point", "Capture background")):
        page = browse(tab, 375)
        page.wait_for_selector(f"text={sign}")
        assert page.evaluate("document.documentElement.scrollWidth") <= 375
