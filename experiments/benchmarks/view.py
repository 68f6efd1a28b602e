"""Age of live frames on the page of `anytouch view`, in Chromium on the same machine, layer by layer.

    python -m experiments.benchmarks.view press.mp4

The film takes the place of a camera. Two names are recorded and trained first. While ages are measured, another
recording is on. Needs Debian's `chromium` and Playwright. A line a layer goes to standard output.
"""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from anytouch_jax.errors import UserError
from experiments.benchmarks import machine
from experiments.command import run_script

_MAIN = "document.getElementById('main').dataset"


@dataclass(frozen=True)
class ViewOptions:
    """Measure the age of live frames with everything on: a head, a recording, force, and each layer in turn."""

    film: Path
    sensor: str = "gelsight_mini"
    seconds: float = 22.0  # For each layer. The page keeps the ages of 600 frames.


def run(options: ViewOptions) -> int:
    """Print a line of JSON for each layer: ms of age at p50, p99 and the largest, and frames drawn in a second."""
    from playwright.sync_api import sync_playwright

    if (chromium := shutil.which("chromium")) is None:
        raise UserError("There is no Chromium: apt-get install chromium")
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as driver:
        words = ["view", options.film, "--live", "--sensor", options.sensor, "--out", folder, "--port", "8797"]
        command = [sys.executable, "-m", "anytouch_jax", *map(str, words)]
        server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        browser = driver.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        try:
            assert server.stdout is not None
            address = next((line.split()[1] for line in server.stdout if line.startswith("Open ")), None)
            if address is None:
                raise UserError("`anytouch view` did not start.")
            page = browser.new_page(viewport={"width": 1280, "height": 900})
            page.goto(address)
            name, record = page.get_by_label("name of what you touch"), page.locator("button.record")
            for called in ("one", "two", "one", "two"):
                name.fill(called)
                record.click()
                page.wait_for_selector(f"text=Recording {called}")
                time.sleep(1)
                record.click()
                page.wait_for_selector("text=Hold to record")
            page.get_by_role("button", name="Train").click()
            page.wait_for_selector("text=recordings that were left out", timeout=180_000)
            name.fill("on")
            record.click()
            for layer in page.locator(".layers button").all():
                layer.click()
                time.sleep(2)
                drawn, begin = _drawn(page), time.perf_counter()
                time.sleep(options.seconds)
                rate = (_drawn(page) - drawn) / (time.perf_counter() - begin)
                ages = dict(zip(("p50", "p99", "largest"), json.loads(page.evaluate(f"{_MAIN}.ages")), strict=True))
                print(json.dumps({"layer": layer.inner_text(), **ages, "drawn_per_s": round(rate, 1)}), flush=True)
        finally:
            browser.close()
            server.send_signal(signal.SIGINT)
            server.wait(60)
    print(json.dumps(asdict(machine.describe())))
    return 0


def _drawn(page: Any) -> int:
    return int(page.evaluate(f"Number({_MAIN}.frames ?? 0)"))


if __name__ == "__main__":
    sys.exit(run_script(ViewOptions, run))
