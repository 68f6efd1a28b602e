"""Placeholders: files that stand for data which was not downloaded."""

from __future__ import annotations

from pathlib import Path

_START = 512  # bytes that tell
_BYTE_ORDER_MARK = b"\xef\xbb\xbf"
_WEB_PAGE = (b"<!doctype html", b"<html", b"<?xml")
_LFS_POINTER = b"version https://git-lfs"


def placeholder(file: str | Path | bytes) -> str | None:
    """Return what takes the place of data in a file, and what to do; None for any other content.

    `file` is a path, or the bytes of a file. A login page and a Git LFS pointer are what downloads
    leave most often under the name of an image or of weights.
    """
    if not isinstance(file, bytes):
        with open(file, "rb") as opened:
            file = opened.read(_START)
    start = file[:_START].removeprefix(_BYTE_ORDER_MARK).lstrip().lower()
    if start.startswith(_WEB_PAGE):
        return "a web page, not the data that its name promises; download the file itself"
    if start.startswith(_LFS_POINTER):
        return "a Git LFS pointer, not the data that its name promises; run `git lfs pull`"
    return None
