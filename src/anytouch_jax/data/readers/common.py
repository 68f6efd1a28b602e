"""What the readers share: folders listed once, frames by number, rows in columns, splits by hash, skips counted.

No reader opens or stats a frame: a folder is listed once and a frame is known by its name.
"""

from __future__ import annotations

import csv
import hashlib
import json
import os
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from anytouch_jax.data.images import natural
from anytouch_jax.errors import UserError

Columns = dict[str, list[Any]]
Frames = list[tuple[int, str]]  # (frame number, file name), by number
SYSTEM_FILES = ("Thumbs.db", "desktop.ini", "__MACOSX")


class DatasetError(UserError):
    """A folder that is not the dataset it is said to be, or a broken list in it; the message names the file."""


@dataclass(frozen=True)
class IndexOptions:
    """What a reader may be told; each reader says in `uses` which of these it heeds.

    `val`, `test`: shares of the groups (objects, else recordings) that go to these splits where a dataset has no
    split of its own. `lists`: a folder with list files, looked into before ROOT. `task`: which lists of Touch and Go
    decide the split. `fold`: which `split_<k>.npy` of Feel. `export`: let a reader write pictures into ROOT where the
    dataset comes as arrays or films. `sensor`: what made one's own recordings. `split_by`: what of these is held
    out whole. `labels`: a table of labels for these, by object or sequence.
    """

    val: float = 0.05
    test: float = 0.05
    lists: Path | None = None
    task: Literal["material", "rough"] = "material"
    fold: int = 0
    export: bool = False
    sensor: str | None = None
    split_by: Literal["object", "recording"] = "object"
    labels: Path | None = None

    def __post_init__(self) -> None:
        if not (0 <= self.val <= 1 and 0 <= self.test <= 1 and self.val + self.test <= 1):
            raise UserError(f"val {self.val} and test {self.test} are shares: both at least 0, together at most 1")


@dataclass
class Notes:
    """What was left out and why (`skipped`: reason -> count and one example), and things to say aloud."""

    skipped: dict[str, tuple[int, str]] = field(default_factory=dict)
    said: list[str] = field(default_factory=list)

    def skip(self, reason: str, example: str, count: int = 1) -> None:
        """Count `count` things left out for `reason`; the first `example` is kept."""
        if count:
            before, first = self.skipped.get(reason, (0, example))
            self.skipped[reason] = before + count, first

    def log(self, sentence: str) -> None:
        """Keep a sentence for the report."""
        self.said.append(sentence)


@dataclass(frozen=True)
class DatasetReader:
    """One public dataset: how to read it, and what is known of it.

    `read(root, options, notes) -> columns` has paths relative to `root` (absolute). `commercial` is False where no
    licence is stated. `paper` is the count of contact frames in the paper's dataset table, None where it has none.
    """

    name: str
    read: Callable[[Path, IndexOptions, Notes], Columns]
    sensor: str
    license: str
    commercial: bool
    about: str
    url: str
    citation: str
    uses: tuple[str, ...] = ("val", "test")
    paper: int | None = None
    paper_note: str = ""


class RowBuilder:
    """Columns that grow by whole recordings."""

    def __init__(self, *names: str) -> None:
        fixed = ("path", "sensor", "sequence", "frame_index", "split")
        self._columns: Columns = {name: [] for name in (*fixed, *names)}

    def add(self, paths: Sequence[str], **cells: Any) -> None:
        """Append one row a path; a cell is a list (one value a row) or one value for all rows; None is null."""
        columns = self._columns
        unknown = cells.keys() - columns.keys()
        if unknown:
            raise KeyError(f"undeclared columns {sorted(unknown)}")
        columns["path"].extend(paths)
        for name, column in columns.items():
            if name != "path":
                value = cells.get(name)
                column.extend(value if isinstance(value, list) else [value] * len(paths))
                if len(column) != len(columns["path"]):
                    raise ValueError(f"column {name!r} has {len(column)} values for {len(columns['path'])} rows")

    def columns(self) -> Columns:
        """Everything added, without optional columns that are null on every row."""
        return {
            name: column
            for name, column in self._columns.items()
            if name in ("path", "sensor", "sequence", "frame_index", "split")
            or any(value is not None for value in column)
        }


def listing(folder: Path, notes: Notes) -> tuple[list[str], list[str]]:
    """Names of the folders (2 before 10) and of the files in `folder`; links and system files are counted."""
    folders: list[str] = []
    files: list[str] = []
    try:
        entries = list(os.scandir(folder))
    except OSError as error:
        raise DatasetError(f"{folder} cannot be listed: {error.strerror}") from None
    for entry in entries:
        name = entry.name
        if name.startswith(".") or name in SYSTEM_FILES:
            notes.skip("hidden or system file", entry.path)
        elif not _is_text(name):
            notes.skip("name that is not UTF-8", repr(entry.path))
        elif entry.is_symlink():
            notes.skip("symbolic link (a manifest's paths may not leave its folder)", entry.path)
        else:
            (folders if entry.is_dir(follow_symlinks=False) else files).append(name)
    return sorted(folders, key=natural), sorted(files)


def walk(base: Path, notes: Notes, inside: str = "") -> Iterator[tuple[str, list[str], list[str]]]:
    """(folder relative to `base`, its folders, its files) of `base` and everything below, in natural order."""
    folders, files = listing(base / inside, notes)
    yield inside, folders, files
    for folder in folders:
        yield from walk(base, notes, f"{inside}/{folder}" if inside else folder)


def numbered(files: Sequence[str], pattern: str, notes: Notes, where: str) -> Frames:
    """The files whose whole name matches `pattern`, with the number its first group holds, by number.

    Other files, and a second file of one number, are counted in `notes`.
    """
    match = re.compile(pattern, re.IGNORECASE).fullmatch
    frames: dict[int, str] = {}
    for name in files:
        found = match(name)
        if not found or len(found[1]) > 18:  # a manifest holds numbers of 64 bits
            notes.skip("file that is not a frame by its name", f"{where}/{name}")
        elif int(found[1]) in frames:
            notes.skip("second file of one frame number", f"{where}/{name}")
        else:
            frames[int(found[1])] = name
    return sorted(frames.items())


def find_folder(root: Path, *choices: str, inside: Sequence[str] = ()) -> Path:
    """The first of the folders `choices` under `root` that exists ("." is `root` itself).

    A choice counts only if it holds one of `inside`, where given. Raises DatasetError that says what was looked for.
    """
    for choice in choices:
        folder = root / choice
        if folder.is_dir() and (not inside or any((folder / name).is_dir() for name in inside)):
            return folder
    one = " or ".join(f"a folder {name!r}" for name in inside or [c for c in choices if c != "."])
    places = ", ".join(str(root / choice) for choice in choices) if inside else str(root)
    raise DatasetError(f"expected {one} in {places}; is ROOT the folder that holds it?")


def find_file(names: Collection[str], *folders: Path | None) -> Path | None:
    """The first file called one of `names` in `folders`."""
    files = (folder / name for folder in folders if folder is not None for name in names)
    return next((file for file in files if file.is_file()), None)


def read_csv(path: Path) -> list[list[str]]:
    """The rows of a CSV file (UTF-8, with or without BOM), blank lines left out. Raises DatasetError."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            return [[cell.strip() for cell in row] for row in csv.reader(file) if any(cell.strip() for cell in row)]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DatasetError(f"{path} cannot be read as a CSV list: {error}") from None


def read_table(path: Path) -> list[dict[str, str]]:
    """The rows of a CSV file with a header, as dicts. Raises DatasetError."""
    rows = read_csv(path)
    return [dict(zip(rows[0], row, strict=False)) for row in rows[1:]]


def read_json(path: Path, values: type = object) -> dict[str, Any]:
    """The object (names with `values` of a kind) that a JSON file holds. Raises DatasetError."""
    try:
        found = json.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError, RecursionError) as error:
        raise DatasetError(f"{path} cannot be read as JSON: {error}") from None
    if not isinstance(found, dict) or not all(isinstance(value, values) for value in found.values()):
        kind = "" if values is object else f" with a {values.__name__} for every name"
        raise DatasetError(f"{path}: expected a JSON object{kind}")
    return found


def hash_split(dataset: str, group: str, options: IndexOptions) -> str:
    """The split of a group: the first 8 bytes of SHA-256(dataset / group) as a share of their range.

    Below `val` it is val, below `val + test` test, else train: one group is never in two splits, and adding or
    losing other groups moves none.
    """
    digest = hashlib.sha256(f"{dataset}/{group}".encode()).digest()
    share = int.from_bytes(digest[:8], "big") / 2**64
    return "val" if share < options.val else "test" if share < options.val + options.test else "train"


def contact_list(root: Path, options: IndexOptions, names: Collection[str], marker: str) -> dict[str, list[str]] | None:
    """The authors' list of contact frames, where one of the CSV files `names` is there: path -> its cells.

    Paths are taken from behind the last folder called `marker` on, where they have one.
    """
    path = find_file(names, options.lists, root)
    if path is None:
        return None
    rows = ((row[0].replace("\\", "/"), row) for row in read_csv(path))
    return {name.rpartition(f"{marker}/")[2]: row for name, row in rows}


def add_recording(
    rows: RowBuilder,
    frames: Frames,
    folder: str,
    *,
    split: str,
    listed: Mapping[str, Sequence[str]] | None = None,
    key: str = "",
    **cells: Any,
) -> int:
    """Add the frames of one recording; the count of those in the contact list (0 without one).

    With `listed` (keys `key`/name) a frame in it is contact, and every other one gets split `unused`.
    """
    names = [name for _, name in frames]
    if listed is not None:
        contact = [f"{key}/{name}" in listed for name in names]
        cells |= {"label.contact": [int(one) for one in contact]}
        cells |= {"split": [split if one else "unused" for one in contact]}
    else:
        cells["split"] = split
    rows.add([f"{folder}/{name}" for name in names], frame_index=[number for number, _ in frames], **cells)
    return sum(cells["label.contact"]) if listed is not None else 0


def miss_listed(notes: Notes, listed: Mapping[str, Sequence[str]] | None, found: int) -> None:
    """Count the listed contact frames that are not on disk."""
    if listed is not None:
        notes.skip("listed contact frame that is not on disk", "see the contact list", len(listed) - found)


def _is_text(name: str) -> bool:
    try:
        name.encode()
    except UnicodeEncodeError:
        return False
    return True
