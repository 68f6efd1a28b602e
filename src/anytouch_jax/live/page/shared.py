"""The manifest of a folder that several pages record into.

Two pages are two processes. Every change reads the file again under a lock, because another page
may have written since, and what it wrote must stay.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.errors import UserError
from anytouch_jax.files import lock

# What of a file tells that it is another one: a change replaces the file.
Stamp = tuple[int, int, int] | None
_PATIENCE = 30.0  # seconds to wait for the change of another page, which takes milliseconds
_PAUSE = 0.01


class SharedManifest:
    """The manifest.parquet of recordings, which other processes may change at any time."""

    def __init__(self, folder: Path) -> None:
        self.file = folder / "manifest.parquet"
        self._lock = folder / ".manifest.lock"

    def stamp(self) -> Stamp:
        """Return what changes with every change of the file, None without a file."""
        try:
            about = self.file.stat()
        except OSError:
            return None
        return about.st_ino, about.st_mtime_ns, about.st_size

    def read(self) -> Manifest:
        """Return the manifest. Raises UserError."""
        return manifests.read(self.file)

    def append(self, columns: dict[str, list[Any]]) -> None:
        """Add rows. Raises UserError, and OSError."""
        with self.locked():
            new = manifests.from_columns(columns, self.file)
            if self.file.exists():
                tables = [self.read().table, new.table]
                joined = pa.concat_tables(tables, promote_options="permissive")
                new = manifests.from_columns(joined.to_pydict(), self.file)
            manifests.write(new, self.file)

    def leave_out(self, sequence: str) -> None:
        """Mark the rows of a recording as unused.

        Raises UserError if there is no such recording, and OSError.
        """
        with self.locked():
            if not self.file.is_file():
                raise UserError("There is no such recording.")
            now = self.read()
            is_it = now.text_column("sequence") == sequence
            if not is_it.any():
                raise UserError("There is no such recording.")
            split = np.where(is_it, "unused", now.text_column("split"))
            manifests.write(manifests.replace_column(now, "split", split.tolist()), self.file)

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Keep others from changing the folder's files.

        Raises UserError if another page does not end its change.
        """
        end = time.monotonic() + _PATIENCE
        while True:
            # A file of its own is locked, since the manifest is replaced by every change.
            with lock(self._lock) as is_free:
                if is_free:
                    yield
                    return
            if time.monotonic() > end:
                raise UserError(
                    f"Another page has been changing {self.file.parent} for {_PATIENCE:g} s. "
                    "Close it, and try again."
                )
            time.sleep(_PAUSE)
