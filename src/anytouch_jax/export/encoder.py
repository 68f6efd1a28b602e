"""An exported encoder in the place of the one that it was made of.

`load_encoder` enters here for an .onnx file. For that reason, and because `embed`, `stream` and
probes take it, it has the interface of `Encoder`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from anytouch_jax.batch import FieldOutput
from anytouch_jax.config import UNIVERSAL, from_json
from anytouch_jax.encoder.arrays import METADATA, Aggregation, Engine, Pooling, rows_of_sensors
from anytouch_jax.encoder.base import Encoder, as_clips
from anytouch_jax.encoder.measured import missing
from anytouch_jax.errors import UserError
from anytouch_jax.export.export import Exported, load
from anytouch_jax.renamed import keywords


@dataclass(frozen=True, repr=False)
class EngineEncoder(Encoder):
    """An exported encoder on an engine: for one number of frames and one pooling.

    It has no parameters.
    """

    run: Exported = field(kw_only=True, repr=False)

    @cached_property
    def fingerprint(self) -> str:
        """That of the encoder it was exported from, so that its heads and indexes serve."""
        return str(self.run.about["weights"])

    @property
    def contract(self) -> str:
        """Everything but the parameters that decides its features, as text."""
        return str(self.run.about["sha256"])

    @property
    def backgrounds(self) -> dict[str, np.ndarray]:
        """Images of the untouched gel by unit, of the touches that int8 was calibrated on."""
        return self.run.backgrounds

    @property
    def runs_in_jax(self) -> bool:
        """Whether `traceable` gives it as a function of jax: it has no parameters for it."""
        return False

    @property
    def measures(self) -> bool:
        """Whether the fields were exported too."""
        return "fields" in self.run.about

    def encode_and_measure(
        self, clips: np.ndarray, rows: np.ndarray, aspect: np.ndarray, pooling: Pooling = "class"
    ) -> tuple[np.ndarray, FieldOutput]:
        """Return features and raw fields of prepared clips, as `Encoder.encode_and_measure`."""
        if not self.measures:
            raise missing(self.source)
        return self.run.measure(clips, rows, aspect)

    def computed_in(self, dtype: Literal["trained", "float32", "bfloat16"]) -> Encoder:
        """Return the same encoder. Raises UserError for bfloat16."""
        if dtype == "bfloat16":
            raise UserError(f"{self.source} is computed in float32 or int8; leave out --dtype")
        return self

    @keywords(join="aggregation")
    def traceable(
        self, pooling: Pooling = "class", aggregation: Aggregation = "mean"
    ) -> Callable[..., Any]:
        """Raise UserError: it has no parameters for jax."""
        raise UserError(
            f"{self.source} has no parameters for jax; name the encoder that it was exported from"
        )

    @keywords(join="aggregation")
    def encode_touch(
        self,
        frames: Any,
        sensor: str | Sequence[str] | np.ndarray = UNIVERSAL,
        *,
        pooling: Pooling = "class",
        aggregation: Aggregation = "mean",
    ) -> np.ndarray:
        """Return features f32 (B, E) of touches of the exported length, as `Encoder.encode_touch`.

        Raises UserError for another pooling or length.
        """
        frames = as_clips(frames)
        about = self.run.about
        if pooling != about["pooling"]:
            raise UserError(
                f"{self.source} has pooling {about['pooling']}, not {pooling}; export it again "
                "with that"
            )
        rows = rows_of_sensors(sensor, len(frames), self.sensor_row, len(self.config.model.sensors))
        if len(frames):
            return self.run(frames, rows)
        return np.zeros((0, about["features"]), np.float32)


def load_engine(path: str | Path, engine: Engine | None = None) -> EngineEncoder:
    """Load an ONNX model of `export` as an encoder, on onnxruntime or another engine.

    Raises UserError.
    """
    run = load(path, engine)
    about = run.about
    if about["form"] != "onnx":
        raise UserError(
            f"{path} is for jax alone; call it by anytouch_jax.load_exported, or export it with "
            "--to onnx"
        )
    trained = about.get("trained_sensors")
    calibration = about.get("fields", {}).get("calibration", {})
    return EngineEncoder(
        from_json(json.dumps(about["config"])),
        {},
        str(path),
        trained_sensors=trained and tuple(map(str, trained)),
        universal_drawn=about["universal_drawn"],
        metadata={METADATA: calibration},
        run=run,
    )
