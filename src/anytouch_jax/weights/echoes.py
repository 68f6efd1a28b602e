"""What Orbax and Tensorstore print beside an error that they raise too."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable
from types import TracebackType
from typing import Any


def echo_less() -> None:
    """Leave such echoes out, in this process: a full disk is one sentence here."""
    logging.getLogger("absl").addFilter(_is_news)  # Orbax logs the traceback of every error of its threads
    sys.excepthook = without_echoes(sys.excepthook)


def without_echoes(hook: Callable[..., Any]) -> Callable[..., Any]:
    """An exception hook that leaves out what Tensorstore's threads say after the write that failed first: the other
    writes of a checkpoint find nobody to tell any more, and each would print a traceback."""

    def told(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        if kind is not RuntimeError or str(error) != "Event loop is closed":
            hook(kind, error, trace)

    return told


def _is_news(record: logging.LogRecord) -> bool:
    return "_SignalingThread" not in record.getMessage()
