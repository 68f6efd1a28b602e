"""Age of a live image on the page of `anytouch view`: from its frame to the browser's canvas.

    python -m experiments.benchmarks.page

The built-in recording takes the place of a camera, with a head taught on it, a recording on, and a
browser on the same two cores. It needs Playwright and Debian's Chromium. Quiet the machine first.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import uvicorn

from anytouch_jax.encoder.encoder import load_encoder
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.tables import markdown_table
from anytouch_jax.live.examples import EXAMPLE, SENSOR
from anytouch_jax.live.page import server
from anytouch_jax.live.page.live import Live
from anytouch_jax.train.progress import to_stderr as log
from experiments.benchmarks import machine
from experiments.command import with_status

LAYERS = ("Image", "Depth", "Surface")  # as their buttons are called
VIEW = {"width": 1440, "height": 900}
TAUGHT = ("dots", "ring")  # the presses of the built-in recording
TAKEN = 2.0  # seconds of a recording
FRAMES = 600  # whose ages make the percentiles, as on the page
PARTS = ("to its packet", "to the browser", "to the canvas")
PATIENCE = 600.0  # seconds to wait for a head or for frames


@contextmanager
def serving(sources: list[Any]) -> Iterator[str]:
    """Serve the page of `sources` by a thread, and give its address."""
    running = uvicorn.Server(
        uvicorn.Config(server.app(sources), port=0, log_level="critical", lifespan="off")
    )
    thread = threading.Thread(target=running.run, daemon=True)
    thread.start()
    while not running.started:
        time.sleep(0.01)
    yield f"http://127.0.0.1:{running.servers[0].sockets[0].getsockname()[1]}/"
    running.should_exit = running.force_exit = True
    thread.join(10)


def wait_for_background(live: Live) -> None:
    """Wait until the untouched gel is known. Before, the first frame waits for the compiler."""
    end = time.monotonic() + PATIENCE
    while live.frames.setup.gel is None:
        if time.monotonic() > end:
            raise UserError(f"The untouched gel was not found within {PATIENCE:g} s.")
        time.sleep(0.1)


def teach(live: Live) -> None:
    """Record each press twice, fit a head, and begin a recording that stays on."""
    for name in 2 * TAUGHT:
        live.recorder.start(name, live.frames.setup.gel)
        time.sleep(TAKEN)
        live.recorder.stop()
    live.teacher.reload()
    live.teacher.train()
    end = time.monotonic() + PATIENCE
    while live.teacher.about()["training"]:
        if time.monotonic() > end:
            raise UserError(f"The head was not fitted within {PATIENCE:g} s.")
        time.sleep(0.2)
    live.recorder.start(TAUGHT[0], live.frames.setup.gel)


def ages_of(page: Any, layer: str) -> dict[str, Any]:
    """Return the ages of FRAMES frames of a layer, as the page counts them."""
    page.reload()
    page.get_by_role("button", name=layer, exact=True).click()
    count = "Number(document.getElementById('main').dataset.frames ?? 0)"
    begin = time.monotonic()
    end = begin + PATIENCE
    # The first second, in which everything is made, is forgotten by the page, too.
    while (shown := page.evaluate(count)) < FRAMES + 50:
        if time.monotonic() > end:
            raise UserError(f"The page drew {shown} frames within {PATIENCE:g} s.")
        page.wait_for_timeout(500)
    ages, parts = (
        json.loads(page.evaluate(f"document.getElementById('main').dataset.{name}"))
        for name in ("ages", "parts")
    )
    rate = shown / (time.monotonic() - begin)
    about = {"layer": layer, "p50": ages[0], "p99": ages[1], "rate": round(rate, 1)}
    return about | dict(zip(PARTS, parts, strict=True))


def measure(model: str, layers: Sequence[str]) -> list[dict[str, Any]]:
    """Return the ages of frames of each layer."""
    from playwright.sync_api import sync_playwright

    chromium = shutil.which("chromium")
    if chromium is None:
        raise UserError("There is no Chromium: apt-get install chromium")
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as driver:
        encoder = load_encoder(model)
        live = Live(EXAMPLE, encoder, sensor=SENSOR, out=Path(folder) / "touches", log=log)
        live.start()
        browser = driver.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        try:
            with serving([live]) as address:
                wait_for_background(live)
                live.frames.capture_background()
                teach(live)
                page = browser.new_page(viewport=VIEW)
                page.goto(address)
                page.wait_for_selector(".layers")
                return [ages_of(page, layer) for layer in layers]
        finally:
            browser.close()
            live.stop()


def parse(args: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--model", default="anytouch-tiny")
    parser.add_argument("--layers", nargs="+", default=LAYERS, metavar="LAYER")
    parser.add_argument("--cores", type=int, default=2, help="that all of it shares")
    return parser.parse_args(args)


def main(args: Sequence[str] | None = None) -> int:
    """Print the ages as a table."""
    options = parse(args)
    # Before anything begins a thread. The browser is a child, and stays on these cores, too.
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: options.cores])
    about = machine.describe()
    rows = measure(options.model, options.layers)
    print(markdown_table(list(rows[0]), [list(row.values()) for row in rows]))
    print(f"{about.sentence()[:-1]}, {os.getloadavg()[0]:.1f} at the end. Times are in ms.")
    return 0


if __name__ == "__main__":
    sys.exit(with_status(main))
