"""OpenCV as this package uses it: one thread, no log, and C libraries that print nothing.

Nothing is changed at import. `set_up` does it when OpenCV is first used for frames.
"""

from __future__ import annotations

import ctypes
import os
import threading

import cv2

_is_set_up = False


def set_up() -> None:
    """Set OpenCV up for frames, once a process. Two threads that come at once do the same twice."""
    global _is_set_up
    if _is_set_up:
        return
    # The loader has threads of its own already. The optical flow of dots depends on the number of
    # threads (a stripe of the image for each), so that one also keeps it reproducible.
    cv2.setNumThreads(1)
    # Our errors say what is wrong with a file. OpenCV's log would hide them.
    if "OPENCV_LOG_LEVEL" not in os.environ:
        if hasattr(cv2, "setLogLevel"):  # OpenCV 4
            cv2.setLogLevel(0)
        else:
            cv2.utils.logging.setLogLevel(0)
    # FFmpeg's own, off. OpenCV reads it when the first video is opened.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    _is_set_up = True


class _Quiet:
    """A context in which the C library's `stderr`, where libjpeg and libpng print, is /dev/null.

    Python writes to descriptor 2, which does not change: no thread loses a sentence. Threads may be
    inside together. A C library in which `stderr` is no variable is left alone.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._inside = 0
        self._own = 0
        self._null = 0
        self._stream: ctypes.c_size_t | None = None
        self._is_found = False

    def __enter__(self) -> None:
        set_up()
        with self._lock:
            if not self._is_found:
                self._find_stream()
            if self._stream is None:
                return
            if not self._inside:
                self._own = self._stream.value
                self._stream.value = self._null
            self._inside += 1

    def __exit__(self, *_: object) -> None:
        if self._stream is not None:
            with self._lock:
                self._inside -= 1
                if not self._inside:
                    self._stream.value = self._own

    def _find_stream(self) -> None:
        """Find the variable `stderr` of the C library, and open what takes its place."""
        self._is_found = True
        # Of glibc alone it is known that `stderr` is a variable, which may be assigned to.
        if "CS_GNU_LIBC_VERSION" not in getattr(os, "confstr_names", ()):
            return
        library = ctypes.CDLL(None)
        library.fopen.restype = ctypes.c_size_t
        self._null = library.fopen(os.devnull.encode(), b"w")
        if self._null:
            self._stream = ctypes.c_size_t.in_dll(library, "stderr")


QUIET = _Quiet()
