"""The page of `anytouch view`: age of live frames in a browser, and seconds to open a large manifest.

    python -m experiments.benchmarks.view press.mp4 --with manifest.parquet features.npz --head head.npz

The film takes the place of a camera. Chromium and Playwright draw the page on the same machine.
A line a measurement goes to `experiments/results/view.jsonl`. `make results` makes the page from that file alone.
"""

from __future__ import annotations

import dataclasses
import json
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet
from tyro.conf import arg

from anytouch_jax.errors import UserError
from experiments.benchmarks import machine
from experiments.command import run_script
from experiments.records import write_record

WINDOW = 20.0  # seconds, in which the page keeps the ages of all frames at 30 frames/s
DRAWN = "Number(document.getElementById('main').dataset.frames ?? 0)"
WARM = 8.0  # seconds until a browser has started
FACTS = """Object.fromEntries([...document.querySelectorAll('.fact')].map(
    (fact) => [fact.firstChild.data, fact.lastChild.textContent]))"""


@dataclass(frozen=True)
class ViewOptions:
    """Measure the page with a film in the place of a camera. Its first 3 s show the untouched gel."""

    film: Path
    known: Annotated[tuple[Path, ...], arg(name="with")] = ()  # Manifest and features, for the nearest known touches.
    head: Path | None = None  # Head of `anytouch probe label --save`.
    sensor: str = "digit"
    windows: int = 3  # Times of 20 s.
    rows: int = 2_500_000  # Rows of the manifest that is opened. 0 opens none.
    picture: Path | None = None  # Also save what the page shows.
    out: Path = Path("experiments/results/view.jsonl")  # JSON lines.


def write_large(folder: Path, rows: int) -> Path:
    """Write a manifest of so many frames of videos of 200 frames. All rows show one of 200 pictures."""
    rng = np.random.default_rng(0)
    (folder / "frames").mkdir()
    for frame in range(200):
        shade = cv2.resize(rng.uniform(40, 215, (5, 6, 3)).astype(np.float32), (320, 240))
        cv2.imwrite(str(folder / f"frames/{frame:010d}.jpg"), np.clip(shade, 0, 255).astype(np.uint8))
    video, frame = np.arange(rows) // 200, np.arange(rows) % 200
    names = [f"frames/{number:010d}.jpg" for number in range(200)]
    table = pa.table({
        "path": pa.array(names).take(pa.array(frame)), "frame_index": pa.array(frame),
        "sequence": pc.binary_join_element_wise("video_", pa.array(video).cast(pa.string()), ""),
        "sensor": pa.array(np.array(["gelsight", "digit", "gelslim"])[video % 3]),
        "split": pa.array(np.array(["train", "train", "train", "val", "test"])[video % 5]),
        "object": pc.binary_join_element_wise("object ", pa.array(video // 50).cast(pa.string()), ""),
    })  # fmt: skip
    pa.parquet.write_table(table, folder / "large.parquet")
    return folder / "large.parquet"


@contextmanager
def page_of(arguments: Sequence[str], browser: Any) -> Iterator[tuple[Any, float]]:
    """Start `anytouch view`, and give its page and the time at which the command began. The page is empty still."""
    begin = time.perf_counter()
    command = [sys.executable, "-m", "anytouch_jax", "view", *arguments, "--port", "8797"]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    page = browser.new_page(viewport={"width": 1200, "height": 900})
    try:
        assert server.stdout is not None
        address = next((line.split()[1] for line in server.stdout if line.startswith("Open ")), None)
        if address is None:
            raise UserError("`anytouch view` did not start.")
        page.goto(address)
        yield page, begin
    finally:
        page.close()
        server.send_signal(signal.SIGINT)
        server.wait(30)


def live(options: ViewOptions, browser: Any, *, alone: bool) -> dict[str, Any]:
    """Return ms of the encoder, and ages of frames on the page in ms: the largest of all windows."""
    known = [] if alone else [str(path) for path in options.known]
    arguments = [str(options.film), *known, "--live", "--sensor", options.sensor]
    arguments += [] if alone or options.head is None else ["--head", str(options.head)]
    ages = []
    with page_of(arguments, browser) as (page, _):
        page.locator("nav button").last.click()
        while not page.evaluate(DRAWN):
            time.sleep(0.05)
        page.keyboard.press("b")
        time.sleep(WARM)
        begin, first = time.perf_counter(), page.evaluate(DRAWN)
        for _ in range(options.windows):
            time.sleep(WINDOW + 1)
            ages.append(json.loads(page.evaluate("document.getElementById('main').dataset.ages")))
        frames = page.evaluate(DRAWN) - first
        seconds, facts = time.perf_counter() - begin, page.evaluate(FACTS)
        if options.picture is not None and not alone:
            page.screenshot(path=options.picture, type="jpeg", quality=80)
    encoder = [float(part) for part in facts["encoder p50, p99"].removesuffix(" ms").split(",")]
    names = ("p50", "p99", "largest")
    return {
        "age": dict(zip(names, np.max(ages, axis=0).tolist(), strict=True)),
        "encoder": dict(zip(names[:2], encoder, strict=True)), "drawn_per_s": frames / seconds,
    }  # fmt: skip


def opened(path: Path, browser: Any, times: int = 5) -> dict[str, Any]:
    """Return the seconds from the command to the first touch on the page."""
    seconds = []
    for _ in range(times):
        with page_of([str(path)], browser) as (page, begin):
            page.wait_for_selector("text=touches")
            seconds.append(time.perf_counter() - begin)
    return {"seconds": seconds}


def run(options: ViewOptions) -> int:
    """Measure, store and print."""
    from playwright.sync_api import sync_playwright

    if (chromium := shutil.which("chromium")) is None:
        raise UserError("There is no Chromium: apt-get install chromium")
    about = dataclasses.asdict(machine.describe())
    with sync_playwright() as driver, tempfile.TemporaryDirectory() as folder:
        browser = driver.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        found = {"camera alone": live(options, browser, alone=True)}
        if options.known or options.head:
            found["all"] = live(options, browser, alone=False)
        if options.rows:
            path = write_large(Path(folder), options.rows)
            found["open"] = opened(path, browser) | {"rows": options.rows}
        browser.close()
    for name, record in found.items():
        write_record(options.out, name, record | {"machine": about})
        print(name, record)
    return 0


if __name__ == "__main__":
    sys.exit(run_script(ViewOptions, run))
