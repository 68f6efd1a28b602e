"""Figures of a run: what stage 1 makes of the first samples of a batch."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from anytouch_jax.batch import Stage2Batch, TouchBatch
from anytouch_jax.data.images import encode
from anytouch_jax.evaluate import reconstruction
from anytouch_jax.files import atomic_write
from anytouch_jax.training.start import Params, Start


def draw_reconstructions(
    step: int, params: Params, batch: TouchBatch | Stage2Batch, *, start: Start
) -> None:
    """Draw the first samples of a batch that has touches to reconstruct.

    Args:
        step: for the name of the image.
        params: of the network.
        batch: whose first samples are drawn.
        start: of the run, with folder, config and network.
    """
    touches: Any = batch
    if isinstance(batch, Stage2Batch):
        if batch.align is None or not start.config.reconstructs:
            return
        touches = batch.align
    # Every process takes part in fetching sharded arrays, and the first one draws.
    clip = np.asarray(jax.device_get(touches.clip[:6]))
    sensor = np.asarray(jax.device_get(touches.sensor[:6]))
    if jax.process_index():
        return
    shown = {name: params[name] for name in ("touch", "decoder")}
    image = reconstruction.reconstruction_panels(
        shown, clip, sensor, net=start.net, config=start.config
    )
    atomic_write(start.run / "figures" / f"reconstruction_{step:06d}.png", encode(image))
