"""Latency of `anytouch stream` with a camera of 30 frames a second, which is made up and sends JPEG.

    python -m experiments.benchmarks.live --seconds 60

The camera shows an example touch of 640 x 480 pixels with fresh noise, so that no frame is reused. Frames are decoded,
resized and embedded as live ones are. Quiet the machine first.
"""

from __future__ import annotations

import argparse
import itertools
import time

import cv2
import numpy as np

from anytouch_jax.encoder.encoder import example_touches, load_encoder
from anytouch_jax.encoder.stream import budget, collect, stream
from experiments.benchmarks import machine

NOISY = 32  # pictures with other noise, shown in turn


class Camera:
    """A camera of `rate` frames a second. A frame that is not grabbed in time is lost, as a driver loses it."""

    def __init__(self, rate: float) -> None:
        rng, frame = np.random.default_rng(0), cv2.resize(example_touches()[0].frame[..., ::-1], (640, 480))
        noisy = (np.clip(frame + rng.normal(0, 4, frame.shape), 0, 255).astype(np.uint8) for _ in range(NOISY))
        self._sent = [cv2.imencode(".jpg", one)[1] for one in noisy]
        self._rate, self._start, self._last = rate, time.perf_counter(), -1

    def grab(self) -> bool:
        passed = (time.perf_counter() - self._start) * self._rate
        self._last = max(self._last + 1, int(passed))
        time.sleep(max(0.0, (self._last - passed) / self._rate))
        return True

    def retrieve(self) -> tuple[bool, np.ndarray]:
        return True, cv2.imdecode(self._sent[self._last % NOISY], cv2.IMREAD_COLOR)

    def release(self) -> None:
        pass


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", default="anytouch-tiny", help="name, run folder or weights file")
    parser.add_argument("--engine", default="auto", help="auto, xla, onnxruntime or openvino")
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--rate", type=float, default=30, help="frames a second")
    options = parser.parse_args()
    encoder = load_encoder(options.model, engine=options.engine)
    live = stream(encoder, Camera(options.rate), live=True, sensor=encoder.sensor_row("digit"))
    some = (frame for frame in itertools.islice(live, int(options.seconds * options.rate)))
    engine = "XLA" if encoder.exported(1) is None else "the export"
    print(machine.describe().sentence(), f"{options.model} on {engine}, --engine {options.engine}", sep="\n")
    print(*budget(collect(some)), sep="\n")
    live.close()


if __name__ == "__main__":
    main()
