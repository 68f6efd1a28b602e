"""Results of measured frames on disk: maps in an .npz and numbers in a CSV file.

They are written as they come, so that memory does not grow with a recording: a frame has 134 kB.
"""

from __future__ import annotations

import contextlib
import csv
import errno
import os
import shutil
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np

from anytouch_jax.encoder.arrays import Array
from anytouch_jax.encoder.measured import Fields
from anytouch_jax.fields.measure import stacked
from anytouch_jax.files import atomic_path, part_path

_CHUNK = 1 << 20  # bytes that are copied at a time


class GrowingArrays:
    """Arrays that grow along their first axis, each in a file of a folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._files: dict[str, IO[bytes]] = {}
        self._forms: dict[str, tuple[np.dtype[Any], tuple[int, ...]]] = {}
        self._counts: dict[str, int] = {}

    def add(self, arrays: Mapping[str, Array]) -> None:
        """Append arrays (n, ...) by name; each has the same type and shape at every call."""
        for name, array in arrays.items():
            if name not in self._files:
                # A name such as about/encoder is no name of a file.
                self._files[name] = open(self._folder / str(len(self._files)), "w+b")  # noqa: SIM115
                self._forms[name] = array.dtype, array.shape[1:]
                self._counts[name] = 0
            assert self._forms[name] == (array.dtype, array.shape[1:])
            self._files[name].write(np.ascontiguousarray(array).tobytes())
            self._files[name].flush()  # a full disk is found now, and not at the end
            self._counts[name] += len(array)

    def save(self, path: Path, more: Mapping[str, Array]) -> None:
        """Write all arrays, and `more`, as one .npz, whole or not at all. Raises OSError."""
        with atomic_path(path) as part, zipfile.ZipFile(part, "w") as archive:
            for name, file in self._files.items():
                kind, axes = self._forms[name]
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    _write_header(member, kind, (self._counts[name], *axes))
                    file.seek(0)
                    shutil.copyfileobj(file, member, _CHUNK)
            for name, array in more.items():
                with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                    np.lib.format.write_array(member, array, allow_pickle=False)

    def close(self) -> None:
        """Close the files."""
        for file in self._files.values():
            with contextlib.suppress(OSError):  # what is not flushed is not wanted any more
                file.close()


def _write_header(file: IO[bytes], kind: np.dtype[Any], shape: tuple[int, ...]) -> None:
    """Write the header of a .npy file."""
    about = {
        "descr": np.lib.format.dtype_to_descr(kind),
        "fortran_order": False,
        "shape": shape,
    }
    np.lib.format.write_array_header_1_0(file, about)


class Results:
    """The .npz of maps and the CSV file of numbers, a line a frame.

    Both are written to a hidden folder beside the .npz, and `save` moves them to their places.
    `close` removes the folder.
    """

    def __init__(self, out: Path) -> None:
        self._out = out
        hidden = part_path(out)
        self._folder = hidden.with_name(f"{hidden.name}.parts")
        self._folder.mkdir()
        self._arrays = GrowingArrays(self._folder)
        self._lines: Any = None
        self._table = self._folder / "numbers.csv"
        self._file = open(self._table, "w", newline="", encoding="utf-8")  # noqa: SIM115
        self._names = list[str]()
        self._times = list[float]()

    def __len__(self) -> int:
        return len(self._names)

    def add(self, measured: Fields, names: Sequence[str], times: Sequence[float]) -> None:
        """Append frames with their names and time stamps, NaN for none.

        Raises OSError with the name of the .npz, because nobody knows the hidden files.
        """
        try:
            self._add(measured, names, times)
        except OSError as error:
            number = error.errno or errno.EIO
            raise OSError(number, error.strerror or str(error), str(self._out)) from error

    def _add(self, measured: Fields, names: Sequence[str], times: Sequence[float]) -> None:
        for row, (name, time) in enumerate(zip(names, times, strict=True)):
            line: dict[str, Any] = {"frame": name, "time": None if np.isnan(time) else time}
            line |= measured.summary(row)
            if self._lines is None:
                self._lines = csv.DictWriter(self._file, list(line))
                self._lines.writeheader()
            self._lines.writerow(line)
        self._file.flush()
        self._arrays.add(stacked([measured]))
        self._names += names
        self._times += times

    def save(self, out: Path, table: Path, about: Mapping[str, str]) -> None:
        """Move the numbers to `table`, and write the maps to `out` with metadata.

        Raises OSError.
        """
        more = {"name": np.array(self._names), "time": np.array(self._times)}
        more |= {f"about/{name}": np.array(value) for name, value in about.items()}
        self._file.flush()
        os.fsync(self._file.fileno())
        self._arrays.save(out, more)
        with atomic_path(table, part=self._table):
            pass  # it is written already

    def close(self) -> None:
        """Remove what was not saved."""
        self._arrays.close()
        with contextlib.suppress(OSError):
            self._file.close()
        shutil.rmtree(self._folder, ignore_errors=True)
