"""Packages of the engines, imported when they are used."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from anytouch_jax.encoder.arrays import Engine
from anytouch_jax.errors import UserError


@contextmanager
def needed(package: str) -> Iterator[None]:
    """Turn an import that fails into a UserError that says what to install."""
    try:
        yield
    except ImportError as error:
        # jax names flatbuffers, which its export needs, in the message alone.
        missing = f"{error.name} is not installed" if error.name else str(error)
        raise UserError(f'{missing}: pip install "{package}"') from None


def imported(engine: Engine) -> Any:
    """Return the package of an engine. Raises UserError if it is not installed."""
    if engine == "openvino":
        # It would fork at its import, to report what is run. A fork of a process that has used jax
        # hangs.
        silenced: dict[str, Any] = {"openvino_telemetry": None}
        sys.modules.update(silenced)
        with needed("openvino"):
            import openvino

            return openvino
    with needed("anytouch_jax[engines]"):
        import onnxruntime

        return onnxruntime
