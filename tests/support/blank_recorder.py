"""Recordings without physics, for tests of what is done with recordings."""

import numpy as np

from anytouch_jax.sim.recorder import ClipOutput
from anytouch_jax.sim.sensing.sensors import SENSORS


class BlankRecorder:
    """Takes the place of `Recorder`: clips that show which recording they are of, without
    physics.
    """

    def __init__(self, scenes, objects, batch):
        self.scenes = scenes

    def record(self, recordings):
        return [self.take(recording) for recording in recordings]

    def take(self, recording):
        frames = self.scenes.frames
        rng = np.random.default_rng(recording.seed)
        labels = {name: rng.random(frames) for name in ("force", "depth", "area", "x", "y", "slip")}
        if SENSORS[recording.sensor].kind == "field":
            return ClipOutput(None, None, rng.random((frames, 20, 20, 6), np.float32), labels)
        image = np.full((frames, 43, 32, 3), recording.seed % 251, np.uint8)
        field = (
            rng.random((frames, 12, 8, len(self.scenes.fields)), np.float32)
            if self.scenes.fields
            else None
        )
        return ClipOutput(image, image[0], field, labels)
