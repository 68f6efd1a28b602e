"""The page in a real browser: Debian's Chromium, alone for a smoke test, and driven by Playwright
for the others.

`make test-all` installs Playwright, and axe from npm, which checks that everybody can use the page.
"""

from __future__ import annotations

import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from view_world import SCRIPT, PressCamera

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.encoder.encoder import load_encoder
from anytouch_jax.live.page import live as live_module
from anytouch_jax.live.page import server
from anytouch_jax.live.page.live import Live
from experiments.benchmarks.page import serving

CHROMIUM = shutil.which("chromium")
AXE = Path(sys.prefix) / "node_modules" / "axe-core" / "axe.min.js"
SIGNS = "of 2 touches", "Click a point", "Teach it a touch", "What do you want"  # of each tab
# a surface is turned by keys
SURFACE = ".stage canvas[tabindex='0']"
FRAMES = "Number(document.getElementById('main').dataset.frames)"
pytestmark = pytest.mark.skipif(
    CHROMIUM is None, reason="there is no Chromium: apt-get install chromium"
)


def test_chromium_shows_the_page(touches, features, tmp_path):
    command = [
        CHROMIUM,
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        f"--user-data-dir={tmp_path}",
        "--dump-dom",
    ]
    with serving(server.open_sources([touches, features])) as address:
        command += ["--virtual-time-budget=10000", address]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    assert "features: touches" in done.stdout and "of 2 touches" in done.stdout


@pytest.fixture(scope="module")
def camera() -> PressCamera:
    made = PressCamera()
    # what nobody teaches
    made._frames["something else"] = [255 - frame for frame in made._frames["pins"]]
    return made


@pytest.fixture(scope="module")
def address(touches, features, camera, tiny_run, tmp_path_factory) -> Iterator[str]:
    """The page without anything named, of touches, features and a video instead of a camera."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(live_module, "open_source", lambda *_: (camera, True))
        out = tmp_path_factory.mktemp("taught") / "touches"
        live = Live(
            "0", load_encoder(tiny_run), sensor="gelsight_mini", out=out, log=lambda _: None
        )
        live.start()
        start = server.StartPage(lambda _: live)
        with serving([*server.open_sources([touches, features]), live, start]) as place:
            yield place
            live.stop()


@pytest.fixture
def browse(address) -> Iterator[Callable[..., object]]:
    """browse(tab, width): the page at a tab.

    In the end nothing may be in the console of any of them.
    """
    playwright = pytest.importorskip("playwright.sync_api")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        faults: list[str] = []

        def opened(tab: int, width: int = 1200, theme: str = "light", **options):
            page = browser.new_page(
                viewport={"width": width, "height": 800}, color_scheme=theme, **options
            )
            page.on("console", lambda message: faults.append(message.text))
            page.on("pageerror", lambda error: faults.append(str(error)))
            page.on("dialog", lambda dialog: faults.append(f"dialog {dialog.message}"))
            page.goto(address)
            page.locator("nav button").nth(tab).click()
            return page

        yield opened
        browser.close()
        # orders that are refused
        assert [fault for fault in faults if "400 (Bad Request)" not in fault] == []


def until(page, expression: str, argument: object = None, seconds: float = 60) -> None:
    """Wait until a JavaScript expression is true.

    The page's policy forbids eval, which Playwright's own wait needs.
    """
    end = time.monotonic() + seconds
    while not page.evaluate(expression, argument):
        assert time.monotonic() < end, expression
        page.wait_for_timeout(50)


def drawn(page, selector: str = ".stage canvas") -> str:
    """What a canvas shows, once it is not empty."""
    until(page, "s => document.querySelector(s)?.width === 48", selector)
    return page.locator(selector).first.evaluate("canvas => canvas.toDataURL()")


@pytest.mark.slow
def test_touches_are_filtered_and_played(browse):
    page = browse(0)
    page.wait_for_selector("text=of 2 touches")
    assert page.locator("section h3").all_inner_texts() == ["digit", "gelsight_mini"]
    before = drawn(page)
    page.get_by_role("button", name="Contact").click()
    until(page, "before => document.querySelector('.stage canvas').toDataURL() !== before", before)
    page.locator("button", has_text="Play").click()
    until(page, "document.querySelector('input[type=range]').value === '2'")
    page.wait_for_selector("button:has-text('Play')")
    slider, curve = (
        page.locator(name).first.bounding_box() for name in ("input[type=range]", ".time canvas")
    )
    # one time axis
    assert slider["x"] == curve["x"] and slider["width"] == curve["width"]
    page.get_by_role("combobox", name="split", exact=True).select_option("test")
    page.wait_for_selector("text=of 1 touches")
    # text, and no more
    assert page.get_by_text(SCRIPT).count() >= 2 and page.title() == "anytouch view"
    page.get_by_role("combobox", name="sensor", exact=True).select_option("digit")
    until(page, "document.querySelectorAll('.clip').length === 1")


@pytest.mark.slow
def test_a_surface_is_turned(browse):
    page = browse(0)
    page.get_by_role("button", name="Surface").click()
    page.wait_for_selector(SURFACE)
    canvas = page.locator(".stage canvas").first
    seen = set()
    seen.add(canvas.evaluate("canvas => canvas.toDataURL()"))
    for key in ("ArrowLeft", "ArrowDown"):
        canvas.press(key)
        seen.add(canvas.evaluate("canvas => canvas.toDataURL()"))
    canvas.hover()
    page.mouse.down()
    page.mouse.move(500, 400, steps=3)
    page.mouse.up()
    seen.add(canvas.evaluate("canvas => canvas.toDataURL()"))
    # still the first touch
    assert len(seen) == 4 and page.locator("input[type=number]").input_value() == "1"
    page.wait_for_selector("text=measured force, N")  # its curve
    page.get_by_role("button", name="Image").click()
    assert drawn(page) not in seen


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
    until(page, "document.querySelectorAll('.clip').length === 1")
    assert number.input_value() == "1"
    # Tab reaches everything, and what has the focus can be seen
    for _ in range(30):
        page.keyboard.press("Tab")
        if page.evaluate("document.activeElement.ariaLabel") == "next touch":
            break
    assert page.evaluate("getComputedStyle(document.activeElement).outlineStyle") != "none"
    page.keyboard.press("Enter")
    until(page, "document.querySelector('input[type=number]').value === '2'")


@pytest.mark.slow
def test_a_point_of_the_map_shows_its_neighbours(browse):
    page = browse(1)
    page.wait_for_selector(".legend >> text=cup")
    page.locator("canvas.map").click()
    page.wait_for_selector("text=nearest, of other sensors")
    assert 1 <= page.locator(".thumbs figure").count() <= 10
    assert drawn(page)
    chosen = "[...document.querySelectorAll('dd')].map(one => one.textContent).join()"
    shown = {page.evaluate(chosen)}
    # a neighbour lies on one side at least
    for key in ("ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown"):
        page.locator("canvas.map").press(key)
        page.wait_for_timeout(500)
        shown.add(page.evaluate(chosen))
    assert len(shown) > 1
    page.get_by_role("combobox", name="map", exact=True).select_option("tsne")
    page.wait_for_selector("text=12 features")
    page.locator(".thumbs button").first.click()
    page.wait_for_selector("text=of 2 touches")


@pytest.mark.slow
def test_a_classifier_is_taught_by_touching(browse, camera):
    page = browse(2)
    until(page, f"{FRAMES} > 15")
    name = page.get_by_label("name of what you touch")
    record = page.locator("button.record")

    def press(shape: str, called: str, by_key: bool) -> None:
        camera.shape = shape
        name.fill(called)
        page.wait_for_timeout(300)
        record.focus()
        if by_key:
            page.keyboard.down(" ")
        else:
            record.hover()
            page.mouse.down()
        page.wait_for_selector(f"text=Recording {called}")
        page.wait_for_timeout(1000)
        page.keyboard.up(" ") if by_key else page.mouse.up()
        page.wait_for_selector("text=Hold to record")
        camera.shape = ""
        page.wait_for_timeout(300)

    page.keyboard.press("b")
    record.click()  # an empty name
    page.wait_for_selector("text=Type a name")
    assert page.get_by_role("button", name="Train").is_disabled()
    names = ("ball", SCRIPT, "../../" + 294 * "x")
    # with nine recordings it can tell what is new
    for turn in range(3):
        for shape, called in zip(("ball", "bar", "pins"), names, strict=True):
            press(shape, called[:100], by_key=bool(turn))
    page.wait_for_selector("text=3 recordings")
    other = browse(2)  # a second tab has them, too
    until(other, "document.querySelectorAll('.names li').length === 3")
    page.get_by_role("button", name="Train").click()
    camera.shape = "bar"
    until(page, "text => document.querySelector('h2.felt').textContent === text", SCRIPT)
    camera.shape = "ball"
    for each in (page, other):
        until(each, "document.querySelector('h2.felt').textContent === 'ball'", seconds=20)
    camera.shape = "something else"
    until(page, "document.querySelector('h2.felt').textContent === 'Something new'", seconds=20)
    assert page.locator(".feels .bars").is_hidden() and page.get_by_text("nearest name is").count()
    camera.shape = "ball"
    measured = "document.body.innerText.includes('recordings that were left out')"
    until(page, measured, seconds=180)
    page.reload()
    until(page, measured)
    until(page, "document.querySelector('h2.felt').textContent === 'ball'", seconds=20)
    assert page.title() == "anytouch view"
    with page.expect_download() as download:
        page.get_by_role("button", name="Download recordings").click()
    assert download.value.suggested_filename.endswith(".zip")


@pytest.mark.slow
def test_ctrl_c_loses_no_recording(video, tiny_run, tmp_path):
    playwright = pytest.importorskip("playwright.sync_api")
    words = f"view {video} --live --model {tiny_run} --sensor digit --port 8798"
    words += f" --out {tmp_path / 'out'}"
    command = [sys.executable, "-m", "anytouch_jax", *words.split()]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as running:
        place = next(line.split()[1] for line in running.stdout if line.startswith("Open "))
        with playwright.sync_playwright() as driver:
            browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
            page = browser.new_page()
            page.goto(place)
            page.get_by_label("name of what you touch").fill("cup")
            # a short press records until the next
            page.locator("button.record").click()
            page.wait_for_selector("text=/Recording cup: [1-9]/")
            running.send_signal(signal.SIGINT)
            running.send_signal(signal.SIGINT)  # impatient
            running.communicate(timeout=60)
            browser.close()
    table = manifests.read(tmp_path / "out" / "manifest.parquet")
    assert set(table.text_column("object")) == {"cup"} and not list((tmp_path / "out").glob(".2*"))


@pytest.mark.slow
@pytest.mark.parametrize("theme", ["light", "dark"])
def test_everybody_can_use_it(browse, theme):
    """Labels, contrast and roles, by axe."""
    if not AXE.is_file():
        pytest.skip("there is no axe: make test-all")
    for tab, sign in enumerate(SIGNS):
        page = browse(tab, theme=theme, bypass_csp=True)
        page.wait_for_selector(f"text={sign}")
        if tab == 0:
            page.get_by_role("button", name="Surface").click()
            page.wait_for_selector(SURFACE)
        page.evaluate("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
        page.wait_for_timeout(1000)
        page.evaluate(AXE.read_text())
        found = page.evaluate("axe.run()")["violations"]
        assert [(one["id"], node["html"]) for one in found for node in one["nodes"]] == [], sign
        page.close()


@pytest.mark.slow
def test_a_narrow_screen(browse):
    """Nothing is wider than the screen, and everything can be hit with a finger."""
    low = """[...document.querySelectorAll("button, select, input, summary")]
        .filter((one) => one.offsetParent && one.type !== "checkbox")
        .filter((one) => one.getBoundingClientRect().height < 44).map((one) => one.outerHTML)"""
    for tab, sign in enumerate(SIGNS):
        page = browse(tab, 375)
        page.wait_for_selector(f"text={sign}")
        page.wait_for_timeout(500)
        assert page.evaluate("document.documentElement.scrollWidth") <= 375
        assert page.evaluate(low) == []


@pytest.mark.slow
def test_on_a_phone_the_name_is_above_the_image_and_the_button_at_the_bottom(browse, camera):
    page = browse(2, 390)
    camera.shape = "ball"
    until(page, f"{FRAMES} > 15")
    page.wait_for_selector(".feels:visible")
    box = {name: page.locator(name).bounding_box() for name in (".feels", ".stage", ".record")}
    assert box[".feels"]["y"] < box[".stage"]["y"]
    assert 700 < box[".record"]["y"] + box[".record"]["height"] <= 800
    camera.shape = ""


@pytest.mark.slow
def test_touches_are_found_by_their_thumbnails(browse):
    page = browse(0)
    page.wait_for_selector("text=of 2 touches")
    page.get_by_role("button", name="All touches").click()
    until(page, "document.querySelectorAll('.thumbs canvas').length === 2")
    page.get_by_role("combobox", name="split", exact=True).select_option("test")
    until(page, "document.querySelectorAll('.thumbs canvas').length === 1")
    page.locator(".thumbs button").click()
    page.wait_for_selector("text=of 1 touches")
    assert page.locator(".clip").count() == 2


@pytest.mark.slow
def test_answers_that_overtake_each_other_leave_the_newest_on_the_page(browse, camera):
    """On a busy machine an answer may come after that of a later question."""
    page = browse(2)
    until(page, f"{FRAMES} > 5")
    page.evaluate("""() => {
        const plain = window.fetch;
        window.late = [];
        window.fetch = async (path, ...more) => {
            const answer = await plain(path, ...more);
            if (!String(path).endsWith("taught") || window.late.length) return answer;
            await new Promise((go) => window.late.push(go));
            return answer;
        };
    }""")
    record = page.locator("button.record")

    def press(name: str) -> None:
        page.get_by_label("name of what you touch").fill(name)
        record.hover()
        page.mouse.down()
        page.wait_for_selector(f"text=Recording {name}")
        page.wait_for_timeout(600)
        page.mouse.up()
        page.wait_for_selector("text=Hold to record")

    for name in ("early", "later"):
        press(name)
    until(page, "window.late.length === 1")
    page.wait_for_timeout(1000)
    page.evaluate("window.late[0]()")
    page.wait_for_selector(".names >> text=later", timeout=5000)
    page.wait_for_timeout(500)
    assert page.locator(".names >> text=later").count() == 1
    train = page.locator(".teach button", has_text=re.compile("^Train( again)?$"))
    assert train.is_enabled()
    page.close()


@pytest.mark.slow
def test_a_press_right_after_another_records(browse, camera):
    """Frames that are under way still say that the last recording is on."""
    page = browse(2)
    until(page, f"{FRAMES} > 5")
    page.get_by_label("name of what you touch").fill("again")
    orders = []
    page.on(
        "request",
        lambda one: orders.append(one.post_data_json["do"]) if "control" in one.url else None,
    )
    record = page.locator("button.record")
    record.hover()
    page.mouse.down()
    page.wait_for_selector("text=Recording again")
    page.wait_for_timeout(600)
    page.mouse.up()
    page.mouse.down()
    page.wait_for_timeout(800)
    page.mouse.up()
    page.wait_for_selector("text=Hold to record")
    assert orders == ["record", "stop", "record", "stop"]
    page.close()


@pytest.mark.slow
def test_numbers_and_curves_of_live_touch_are_above_the_fold(browse, camera):
    page = browse(2, 1440)
    page.set_viewport_size({"width": 1440, "height": 900})
    until(page, f"{FRAMES} > 15")
    page.wait_for_selector(".look .chart")
    charts = "[...document.querySelectorAll('.look .chart')]"
    lowest = f"Math.max(...{charts}.map((one) => one.getBoundingClientRect().bottom))"
    until(page, f"{lowest} > 0")
    assert page.evaluate(lowest) <= 900


@pytest.mark.slow
def test_a_command_is_broken_between_its_words(browse):
    page = browse(3, 375)
    page.wait_for_selector("code span")
    heights = page.locator("code span").evaluate_all("all => all.map(one => one.offsetHeight)")
    assert len(heights) > 5 and max(heights) < 26


@pytest.mark.slow
def test_what_is_not_known_yet_is_told_from_what_is_missing(browse):
    page = browse(3)
    said = "isMeasured => verdict({}, isMeasured)[0].textContent"
    assert "is being measured" in page.evaluate(said, False)
    assert "Record each name twice" in page.evaluate(said, True)


@pytest.mark.slow
def test_how_far_to_trust_a_force_stands_below_it(browse):
    page = browse(3)
    told = """([calibrated, note]) => {
        const bar = forceBar();
        const force = { force: [0.01, 0, 2], force_low: 1, force_high: 4, sideways_std: 0 };
        const depth = { scale: 1, unit: "mm", depth: 0.5, depth_std: 0.1, area: 3, faults: [] };
        bar.show({ ...force, ...depth, case: "a sensor", calibrated }, "depth", note);
        return bar.node.textContent;
    }"""
    assert "first guess" in page.evaluate(told, [False, ""])
    assert "first guess" not in page.evaluate(told, [True, ""])
    assert "another gel" in page.evaluate(told, [True, "It shows another gel."])
    assert "sideways 0.0 N" in page.evaluate(told, [True, ""]).replace(" ± 0.0", "")
