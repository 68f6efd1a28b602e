"""Helpers of the dataset readers: folder listings, frame numbers, contact lists, splits, counts of
skipped files.

No reader opens or stats a frame. Each folder is listed once, and frames are known by their names. A
folder is its path below the root with a slash at the end, "" for the root itself, so that paths are
joined as text.
"""

from __future__ import annotations

import csv
import hashlib
import io
import os
import pickle
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, Literal

from anytouch_jax.config import FIELD_SENSORS, SENSORS, UNIVERSAL, check_spelling, parse_json
from anytouch_jax.data.manifest.files import open_store
from anytouch_jax.data.manifest.schema import REQUIRED
from anytouch_jax.data.names import natural
from anytouch_jax.errors import UserError
from anytouch_jax.files import csv_lines
from anytouch_jax.progress import Item, tracked

Columns = dict[str, list[Any]]
Frames = dict[int, str]  # frame number -> file name, by number
Folder = tuple[str, list[str], list[str]]  # its path below a base, its folders, its files
_WORDS = {
    "train": "train",
    "training": "train",
    "trn": "train",
    "val": "val",
    "valid": "val",
    "validation": "val",
    "dev": "val",
    "test": "test",
    "testing": "test",
    "tst": "test",
    "eval": "test",
    "evaluation": "test",
    "holdout": "test",
}
# around a word: train_set
_MORE = r"(?:set|sets|split|data|dataset|images?|imgs?|frames|pictures|samples|seen|unseen)"
_SPLIT = re.compile(
    rf"[\W_]*(?:{_MORE}[\W_]+)?({'|'.join(_WORDS)})(?:20\d\d)?(?:[\W_]*{_MORE})*[\W_]*",
    re.IGNORECASE,
)
MOST_LABELS = 1000  # of one value
# in names of cameras and fields
TACTILE = re.compile(r"tactile|gelsight|digit|touch|gel(?![a-z])", re.IGNORECASE)
PARTS = ("train", "val", "test")  # published splits
# Fraction of val and of test that is held out by default.
HELD_OUT = 0.05
# Where that is few objects or recordings, so many are held out, up to a fraction.
_VAL = (5, 0.1)
_TEST = (10, 0.2)
# A score on fewer objects or recordings than this is reported as saying little.
FEWEST_TESTED = 5
NUMBERED = r"(\d+)\.(?:png|jpe?g)"
EXPORT_RECORD = ".anytouch.json"  # in a folder of images that a reader has written
SYSTEM_FILES = ("Thumbs.db", "desktop.ini", "__MACOSX")
_ALLOWED = {  # names in a pickle
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("_codecs", "encode"),
    ("collections", "OrderedDict"),
    *(
        (f"numpy.{core}.multiarray", name)
        for core in ("core", "_core")
        for name in ("_reconstruct", "scalar")
    ),
    *((f"numpy.{core}.numeric", "_frombuffer") for core in ("core", "_core")),
}


class DatasetError(UserError):
    """A folder that is not the expected dataset, or a broken list in it; the message names the
    file.
    """


@dataclass(frozen=True)
class IndexOptions:
    """Options of the readers, as `anytouch data index --help` explains them.

    Each reader names those that it uses.
    """

    val: float | None = None
    test: float | None = None
    lists: Path | None = None
    task: Literal["material", "rough"] = "material"
    fold: int = 0
    export: bool = False
    sensor: str | None = None
    split_by: str | None = None
    singles: bool = False
    videos: bool = False
    order: Literal["names", "times"] = "names"
    labels: Path | None = None
    url: str | None = None
    keys: tuple[str, ...] = ()
    values: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        val = self.val or 0
        test = self.test or 0
        if not (0 <= val <= 1 and 0 <= test <= 1 and val + test <= 1):
            raise UserError(
                f"val {val} and test {test} are fractions: both at least 0, together at most 1"
            )

    def fractions(self, groups: int | None = None) -> tuple[float, float]:
        """Return the fractions of val and test.

        By default both are 5 %. Of so few objects or recordings that this says nothing, more are
        held out, if their number is known: `groups`.
        """
        val = self.val
        test = self.test
        if test is None:
            test = min(_fraction(groups, *_TEST), 1 - (val or 0))
        if val is None:
            val = min(_fraction(groups, *_VAL), 1 - test)
        return val, test


def _fraction(groups: int | None, count: int, most: float) -> float:
    """Return the fraction that `count` of `groups` are, of HELD_OUT to `most`."""
    if not groups:
        return HELD_OUT
    return min(max(count / groups, HELD_OUT), most)


@dataclass(frozen=True)
class DatasetReader:
    """How to read a dataset, and facts: `layout` of a frame for an error, `paper` its contact
    frames in the paper.
    """

    read: Callable[[DatasetIndex], None]
    layout: str
    citation: str
    license: str = "not stated"
    url: str = ""
    uses: tuple[str, ...] = ("val", "test")
    files: tuple[str, ...] = ()  # endings of files that ROOT may be, instead of their folder
    paper: int | None = None
    paper_note: str = ""

    @property
    def commercial(self) -> bool:
        """Whether the licence allows commercial use."""
        return self.license in ("MIT", "CC-BY-4.0")


class DatasetIndex:
    """The manifest rows of a dataset while its folder is read, and what was left out.

    `root` is absolute; all paths of rows are relative to it. `table` maps a column to a value for
    each row, `skipped` a reason to (count, first example), and `notes` are sentences for the user.
    """

    def __init__(
        self,
        name: str,
        root: Path,
        options: IndexOptions | None = None,
        file: str | None = None,
    ) -> None:
        self.name = name
        self.root = root
        self.file = file  # the only one in `root` to be read
        self.options = options or IndexOptions()
        self.skipped: dict[str, tuple[int, str]] = {}
        self.notes: list[str] = []
        # the split of each object or recording that was drawn, not stated by the dataset
        self.drawn: dict[str, str] = {}
        # columns whose values stay in one split
        self.keep_together = ["sequence", "object"]
        # the authors' list of contact frames: path -> its cells
        self.contact: dict[str, list[str]] | None = None
        self._contact_rows = 0
        self.wanted: list[str] = []  # columns that the user asked for
        self.left_out = 0  # frames without a row
        self.written = 0  # images that were written into ROOT
        self.table: Columns = {name: [] for name in REQUIRED}

    @staticmethod
    def tracked(
        items: Iterable[Item], words: str = "folders read", total: int | None = None
    ) -> Iterator[Item]:
        """Yield items below a progress bar."""
        return tracked(items, words, total)

    def skip(self, reason: str, example: str, count: int = 1) -> None:
        """Count `count` things left out for `reason`; the first `example` is reported."""
        if count:
            before, first = self.skipped.get(reason, (0, example))
            self.skipped[reason] = before + count, first

    def skip_all(self, reason: str, examples: Sequence[str]) -> None:
        """Count all of `examples` as left out for `reason`."""
        self.skip(reason, "".join(examples[:1]), len(examples))

    def leave_out(self, reason: str, example: str, count: int = 1) -> None:
        """Count frames that get no row, see `skip`."""
        self.left_out += count
        self.skip(reason, example, count)

    def find_folder(self, *choices: str, inside: Sequence[str] = ("",)) -> str | None:
        """Return the first of the folders `choices` that exists and holds one of `inside` (if any),
        else None.
        """
        for choice in choices:
            folder = self.root / choice
            if folder.is_dir() and any((folder / name).exists() for name in inside):
                if choice:
                    return f"{choice}/"
                return ""
        return None

    def find_file(self, names: Collection[str], *folders: str) -> Path | None:
        """Return the first file called one of `names` in `options.lists` or `folders` (default: the
        root).
        """
        places = [self.options.lists, *(self.root / folder for folder in folders or ("",))]
        files = (folder / name for folder in places if folder is not None for name in names)
        return next((file for file in files if file.is_file()), None)

    def listing(self, folder: str, *, count: bool = True) -> tuple[list[str], list[str]]:
        """Return the names of folders (2 before 10) and files in a folder, if any, without links
        and system files.
        """
        folders: list[str] = []
        files: list[str] = []
        try:
            entries = list(os.scandir(self.root / folder))
        except FileNotFoundError:
            return [], []
        except OSError as error:
            raise DatasetError(f"{self.root / folder} cannot be listed: {error.strerror}") from None
        for entry in entries:
            name = entry.name
            reason = None
            if name == EXPORT_RECORD:
                continue
            is_text = name.encode(errors="ignore").decode() == name
            if name.startswith(".") or name in SYSTEM_FILES:
                reason = "hidden or system file"
            elif not is_text:
                reason = "name that is not UTF-8"
            elif entry.is_symlink():
                reason = "symbolic link (a manifest's paths may not leave its folder)"
            else:
                (folders if entry.is_dir(follow_symlinks=False) else files).append(name)
            if reason and count:
                self.skip(reason, entry.path if is_text else repr(entry.path))
        return sorted(folders, key=natural), sorted(files)

    def walk(
        self,
        base: str = "",
        inside: str = "",
        *,
        count: bool = True,
        enter: Callable[[str], bool] = lambda _: True,
    ) -> Iterator[Folder]:
        """Yield `base` and all folders below it, in order, but those in folders not to `enter`.

        Args:
            base: a folder below ROOT, with "/" at its end; "" for ROOT itself.
            inside: the folder below `base` that the walk begins with.
            count: report what is skipped.
            enter: says by its name whether a folder is entered.
        """
        folders, files = self.listing(f"{base}{inside}", count=count)
        yield inside, folders, files
        entered = [folder for folder in folders if enter(folder)]
        for folder in entered if inside else self.tracked(entered):
            yield from self.walk(base, f"{inside}/{folder}".lstrip("/"), count=count, enter=enter)

    def paths(self, suffix: str, base: str = "") -> list[str]:
        """Return the paths of the files below a folder whose names end in `suffix`."""
        found = (
            f"{folder}/{name}".lstrip("/") for folder, _, files in self.walk(base) for name in files
        )
        return [f"{base}{path}" for path in found if path.endswith(suffix)]

    def shards(self, suffix: str) -> Iterator[tuple[str, Callable[[], BinaryIO]]]:
        """Yield the path of every shard below ROOT, or its address below the option `url`, and how
        to open it.
        """
        if self.options.url is None:
            for path in tracked(self.paths(suffix), "shards read"):
                opened: Callable[[], Any] = partial((self.root / path).open, "rb")
                yield path, opened
            return
        url = self.options.url.rstrip("/")
        system, base = open_store(url)
        try:
            paths = sorted(path for path in system.find(base) if path.endswith(suffix))
        except Exception as error:  # each store has its own kinds
            raise UserError(
                f"{url} cannot be listed: {' '.join(str(error).split())[:200]}; check access"
            ) from None
        for path in self.tracked(paths, "shards read"):
            yield f"{url}{path.removeprefix(base.rstrip('/'))}", partial(system.open, path, "rb")

    def need_sensor(self) -> str:
        """Return the sensor of the option. Raises UserError without one."""
        known = [name for name in SENSORS if name not in (*FIELD_SENSORS, UNIVERSAL)]
        if self.options.sensor is None or self.options.sensor in (*FIELD_SENSORS, UNIVERSAL):
            raise UserError(
                f"name the sensor of these images with --sensor: {', '.join(known)}, or a new name"
            )
        check_spelling(self.options.sensor)
        return self.options.sensor

    def need_export(self, what: str) -> None:
        """Raise DatasetError without the option `export`: the images of `what` must be written as
        files.
        """
        if not self.options.export:
            raise DatasetError(
                f"{self.root} has {what}; add --export to write their images next to them"
            )

    def frames(
        self,
        folder: str,
        pattern: str = NUMBERED,
        files: Sequence[str] | None = None,
        *,
        count: bool = True,
    ) -> Frames:
        """Return the files whose whole name matches, by the number in its first group.

        Others are skipped.

        Args:
            folder: below ROOT.
            pattern: a regular expression of whole names, whose first group is the number.
            files: names in the folder, by default all.
            count: report what is skipped.
        """
        files = self.listing(folder)[1] if files is None else files
        match = re.compile(pattern, re.IGNORECASE).fullmatch
        frames: Frames = {}
        for name in files:
            parts = match(name)
            if not parts or len(parts[1]) > 18:  # a manifest holds numbers of 64 bits
                self.skip("file that is not a frame by its name", f"{folder}/{name}", int(count))
            elif int(parts[1]) in frames:
                self.leave_out("second file of one frame number", f"{folder}/{name}", int(count))
            else:
                frames[int(parts[1])] = name
        return dict(sorted(frames.items()))

    def rgb_images(
        self, folder: str, names: Iterable[str], on_disk: Collection[str]
    ) -> list[str | None]:
        """Return the path of each of `names` in `folder`, None for those that are not `on_disk`,
        which are counted.
        """
        paths = [f"{folder}/{name}" if name in on_disk else None for name in names]
        self.skip("RGB image missing (kept without)", folder, paths.count(None))
        return paths

    def split_of(self, group: str) -> str:
        """Return the hash split of a group (an object or a recording) of this dataset."""
        split = hash_split(self.name, group, self.options)
        self.drawn[group] = split
        return split

    def note_on_few(self) -> None:
        """Note that a drawn split has too few objects or recordings to test on."""
        parts = list(self.drawn.values())
        tested = parts.count("test")
        wanted = self.options.test is None or self.options.test > 0
        if not wanted or tested >= FEWEST_TESTED or len(parts) < 2:
            return
        if any("for split test" in note for note in self.notes):  # each class has one alone
            return
        column = "object" if "object" in self.keep_together and "object" in self.table else None
        self.notes.append(
            f"split test has {tested} of {len(parts)} objects or recordings, and a score on so few "
            "says little: --test 0.3 holds out more, and `anytouch probe label --leave-out "
            f"{column or 'sequence'}` tests each in turn"
        )

    def read_captions(
        self, folder: str, key: Callable[[str], str]
    ) -> tuple[set[str], dict[str, str]]:
        """Return the frames of test.csv, and the captions of train.csv and test.csv, by `key` of
        their `tactile`.
        """
        tests: set[str] = set()
        captions: dict[str, str] = {}
        for split in ("train", "test"):
            path = self.root / folder / f"{split}.csv"
            if not path.is_file():
                what = "captions and no test frames" if split == "test" else "captions"
                self.notes.append(f"no {folder}{split}.csv: no {what} of it")
                continue
            for row in read_table(path, "tactile"):
                frame = key(row["tactile"])
                if row.get("caption"):
                    captions[frame] = row["caption"]
                if split == "test":
                    tests.add(frame)
        return tests, captions

    def read_contact_list(self, names: Collection[str], marker: str) -> None:
        """Read the authors' list of contact frames, if any: `contact` is by the path behind the
        last `marker`/.
        """
        path = self.find_file(names)
        if path is not None:
            rows = ((row[0].replace("\\", "/"), row) for _, row in read_lines(path))
            self.contact = {name.rpartition(f"{marker}/")[2]: row for name, row in rows}

    def listed(self, key: str, frames: Frames, cell: int) -> list[str]:
        """Return one cell of the contact list for each frame, "" for those without it."""
        rows = [(self.contact or {}).get(f"{key}/{name}", []) for name in frames.values()]
        return [row[cell] if len(row) > cell else "" for row in rows]

    def add(self, paths: Sequence[str], **cells: Any) -> None:
        """Add a row for each path; a cell is a list (a value for each row) or one value for all
        rows (None: null).
        """
        before = len(self.table["path"])
        size = len(paths)
        for name, value in {"path": list(paths), **cells}.items():
            values = value if isinstance(value, list) else [value] * size
            if len(values) != size:
                raise ValueError(f"column {name!r} has {len(values)} values for {size} rows")
            self.table.setdefault(name, [None] * before).extend(values)
        for column in self.table.values():
            column.extend([None] * (before + size - len(column)))

    def add_recording(
        self, frames: Frames, folder: str, *, split: str, key: str = "", **cells: Any
    ) -> None:
        """Add the frames of a recording; those that a contact list lacks, by `key`/name, get the
        split `unused`.

        Args:
            frames: names of files by their number.
            folder: below ROOT, that holds them.
            split: train, val, test or unused.
            key: of the recording in the contact list.
            cells: further columns, a value for all rows or a list of one each.
        """
        cells["split"] = split
        if self.contact is not None:
            is_contact = [f"{key}/{name}" in self.contact for name in frames.values()]
            self._contact_rows += sum(is_contact)
            cells |= {"label.contact": [int(touched) for touched in is_contact]}
            cells |= {"split": [split if touched else "unused" for touched in is_contact]}
        self.add(
            [f"{folder}/{name}".lstrip("/") for name in frames.values()],
            frame_index=list(frames),
            **cells,
        )

    def columns(self) -> Columns:
        """Return the columns, without optional ones that are all null; report what was not
        matched.
        """
        if self.contact is not None:
            missing = len(self.contact) - self._contact_rows
            self.skip("listed contact frame that is not on disk", "see the contact list", missing)
        has_value = {
            name: any(value is not None for value in column) for name, column in self.table.items()
        }
        lost = [name for name in dict.fromkeys(self.wanted) if not has_value.get(name)]
        self.notes += [
            f"no row has a value of {name}, so the manifest has no such column" for name in lost
        ]
        return {
            name: column
            for name, column in self.table.items()
            if name in REQUIRED or has_value[name]
        }


def split_word(name: str) -> str | None:
    """Return the split that a folder's name says, in any case: Training, valid, test_set; None for
    others.
    """
    match = _SPLIT.fullmatch(name)
    return match and _WORDS[match[1].lower()]


def label_cells(name: str, values: list[Any]) -> dict[str, list[Any]]:
    """Return values by label: NAME, NAME_0.. of vectors, NAME_key of objects.

    Raises DatasetError above MOST_LABELS.
    """
    rows = [dict(_flat(value)) for value in values]
    places = dict.fromkeys(place for row in rows for place in row)
    if len(places) > MOST_LABELS:
        raise DatasetError(
            f"{name} has {len(places)} values a frame, too many for labels; choose another"
        )
    return {"_".join([name, *place]): [row.get(place) for row in rows] for place in places or [()]}


def _flat(value: Any, place: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield the numbers and texts of a value, with their places in its lists and objects."""
    if isinstance(value, list | dict):
        for at, one in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _flat(one, (*place, str(at)))
    elif value is not None:
        yield place, int(value) if isinstance(value, bool) else value


def hash_split(dataset: str, group: str, options: IndexOptions) -> str:
    """Return val, test or train by the fraction of SHA-256(dataset/group) in its range.

    Other groups move none.
    """
    val, test = options.fractions()
    digest = hashlib.sha256(f"{dataset}/{group}".encode()).digest()
    fraction = int.from_bytes(digest[:8], "big") / 2**64
    if fraction < val:
        return "val"
    if fraction < val + test:
        return "test"
    return "train"


def published_splits(
    path: Path, lists: Mapping[str, Iterable[Any]], key: Callable[[Any], Any] = str
) -> dict[Any, str]:
    """Return `key` of member -> split from the lists train, val, test of a file.

    Raises DatasetError for overlaps.
    """
    splits: dict[Any, str] = {}
    for part in PARTS:
        try:
            members = [key(member) for member in lists.get(part, ())]
        except (TypeError, ValueError, IndexError, KeyError) as error:
            raise DatasetError(f"{path}: its list {part} is not as expected: {error}") from None
        for member in members:
            if splits.setdefault(member, part) != part:
                raise DatasetError(f"{path}: {member} is in {splits[member]} and in {part}")
    return splits


def read_lines(path: Path) -> list[tuple[int, list[str]]]:
    """Return (number of its first line, from 1, cells) of each row of a CSV file.

    Raises DatasetError.
    """
    try:
        lines = [(line, [cell.strip() for cell in cells]) for line, cells in csv_lines(path)]
        return [(line, row) for line, row in lines if any(row)]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DatasetError(f"{path} cannot be read as a CSV list: {error}") from None


def read_table(path: Path, column: str) -> list[dict[str, str]]:
    """Return the rows of a CSV file with a header as dicts.

    Raises DatasetError, also if a row has no `column`.
    """
    rows = [row for _, row in read_lines(path)]
    table = [dict(zip(rows[0], row, strict=False)) for row in rows[1:]]
    if any(column not in row for row in table):
        raise DatasetError(
            f"{path}: expected a column {column!r} in every row, found {', '.join(rows[0])}"
        )
    return table


def read_json(path: Path, values: type = object) -> dict[str, Any]:
    """Return the object in a JSON file, whose values are of one type. Raises DatasetError."""
    try:
        content = parse_json(path.read_text(encoding="utf-8-sig"))
    except (OSError, UnicodeDecodeError, UserError) as error:
        raise DatasetError(f"{path} cannot be read as JSON: it {error}") from None
    if not isinstance(content, dict) or not all(
        isinstance(value, values) for value in content.values()
    ):
        kind = "" if values is object else f" with a {values.__name__} for every name"
        raise DatasetError(f"{path}: expected a JSON object{kind}")
    return content


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _ALLOWED:
            raise pickle.UnpicklingError(f"it asks for {module}.{name}")
        return super().find_class(module, name)


def read_pickle(path: Path) -> Any:
    """Return plain values and arrays of a pickle, or behind a .npy header.

    No code is run. Raises DatasetError.
    """
    try:
        data = path.read_bytes()
        return _Unpickler(
            io.BytesIO(data.partition(b"\n")[2] if path.suffix == ".npy" else data)
        ).load()
    except Exception as error:  # a damaged pickle fails anywhere
        raise DatasetError(
            f"{path} is no pickle of plain values and arrays: {error}; download it again"
        ) from None
