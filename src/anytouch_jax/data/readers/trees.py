"""Folder trees of recordings: which folder is a split, which the object, and whether pictures are frames of a film."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from anytouch_jax.data.images import ImageError, decode
from anytouch_jax.data.readers.common import DatasetError

_WORDS = {"train": "train", "training": "train", "trn": "train", "val": "val", "valid": "val", "validation": "val",
          "dev": "val", "test": "test", "testing": "test", "tst": "test", "eval": "test", "evaluation": "test",
          "holdout": "test"}  # fmt: skip
_MORE = r"(?:set|sets|split|data|dataset|images?|imgs?|frames|pictures|samples)"  # around a word, as in train_set
_SPLIT = re.compile(rf"[\W_]*(?:{_MORE}[\W_]+)?({'|'.join(_WORDS)})(?:[\W_]*{_MORE})?[\W_]*", re.IGNORECASE)
_TINY = (32, 24)
_FILM = 0.75  # largest difference of neighbouring pictures of a film, as a share of that of any two
_SLOW = 5  # seconds between the files of single pictures
_STILL = 1.0  # grey levels: pictures that differ by less show nothing


class Place(NamedTuple):
    """How a folder was understood. `kinds` names its parts, `name` is its path without its split."""

    split: str | None
    object: str | None
    name: str
    parts: tuple[str, ...]
    kinds: tuple[str, ...]


def split_word(name: str) -> str | None:
    """Return the split that a folder's name says, in any case: Training, valid, test_set; None for others."""
    match = _SPLIT.fullmatch(name)
    return match and _WORDS[match[1].lower()]


def understand(folders: Iterable[str]) -> dict[str, Place]:
    """Return how each folder of pictures is understood. Raises DatasetError for one in two splits.

    Split words decide the split at any level. The object is the first other folder, without those above all splits.
    """
    parts = {folder: tuple(part for part in folder.split("/") if part) for folder in folders}
    above, rest = list[tuple[str, ...]](), list[int]()
    for folder, names in parts.items():
        words = [split_word(name) for name in names]
        if len(set(words) - {None}) > 1:
            named = " and ".join(name for name, word in zip(names, words, strict=True) if word)
            raise DatasetError(f"{folder} names two splits, {named}; rename one of these folders")
        if any(words):
            above.append(names[: next(at for at, word in enumerate(words) if word)])
            rest.append(words.count(None))
    wrapping = [len(set(level)) == 1 for level in zip(*above, strict=False)]
    shared = max(0, min([(*wrapping, False).index(False), *(count - 1 for count in rest if count)]))
    return {folder: _place(names, shared) for folder, names in parts.items()}


def _place(names: tuple[str, ...], shared: int) -> Place:
    words = [split_word(name) for name in names]
    split = next((word for word in words if word), None)
    kinds, obj, shared = list[str](), None, shared if split else 0
    for at, (name, word) in enumerate(zip(names, words, strict=True)):
        is_object = word is None and obj is None and at >= shared
        obj = name if is_object else obj
        kinds.append("<split>" if word else "<object>" if is_object else name if at < shared else "<recording>")
    own = [name for name, word in zip(names, words, strict=True) if not word]
    return Place(split, obj, "/".join(own), names, tuple(kinds))


def sequences(recordings: Sequence[tuple[Place, str, list[str]]], films: Sequence[bool]) -> list[list[str]]:
    """Return the sequence of every picture of each recording (place, finger, pictures): its own if it is no film.

    No two recordings have one: the split is added where names repeat between splits, and else a number.
    """
    names = [
        [f"{place.name}/{unit}"] * len(pictures) if is_film else [f"{place.name}/{picture}" for picture in pictures]
        for (place, unit, pictures), is_film in zip(recordings, films, strict=True)
    ]
    names = [[name.strip("/") or "." for name in one] for one in names]
    splits = [place.split for place, *_ in recordings]
    of_split = {(name, split) for one, split in zip(names, splits, strict=True) for name in one}
    if len(of_split) > len({name for name, _ in of_split}):
        names = [[f"{name} ({split})" if split else name for name in one]
                 for one, split in zip(names, splits, strict=True)]  # fmt: skip
    counts: Counter[str] = Counter()
    for one in names:
        counts.update({*one})
        one[:] = [name if counts[name] < 2 else f"{name} ({counts[name]})" for name in one]
    return names


def sentence(places: Sequence[Place], films: Sequence[bool]) -> str:
    """Return how the tree was understood: its levels, the folders of splits, and what a picture is."""
    forms: Counter[str] = Counter()
    words: dict[str, str] = {}
    for place, is_film in zip(places, films, strict=True):
        last = "frames" if is_film else "<touch>"
        form = [kind for at, kind in enumerate(place.kinds) if kind != "<recording>" or place.kinds[at - 1] != kind]
        forms["/".join([*form, last])] += 1
        words |= {part: str(split_word(part)) for part, kind in zip(place.parts, place.kinds, strict=True)
                  if kind == "<split>" and split_word(part) != part}  # fmt: skip
    first, *others = [form for form, _ in forms.most_common(3)]
    more = f" (also {', '.join(others)})" if others else ""
    named = ", ".join(f"{word} is split {split}" for word, split in words.items())
    return f"folders are understood as {first}{more}" + (f"; {named}" if named else "")


def moves_like_film(folders: Sequence[Sequence[Path]]) -> bool:
    """Return whether neighbouring pictures are more alike than others, and were not stored seconds apart.

    A few pictures of each folder are read. Pictures that cannot be read, or show nothing, do not count.
    """
    near, far, gaps = list[float](), list[float](), list[float]()
    for paths in folders:
        starts = np.unique(np.linspace(0, len(paths) - 2, 4).astype(int))
        try:
            tiny = {at: _tiny(paths[at]) for at in sorted({*starts.tolist(), *(starts + 1).tolist()})}
            gaps += [abs(os.stat(paths[at + 1]).st_mtime - os.stat(paths[at]).st_mtime) for at in starts]
        except (ImageError, OSError):
            continue
        near += [float(np.abs(tiny[at] - tiny[at + 1]).mean()) for at in starts]
        far += [float(np.abs(tiny[a] - tiny[b]).mean()) for a, b in combinations(tiny, 2) if b - a > 1]
    is_slow = bool(gaps) and float(np.median(gaps)) > _SLOW
    is_alike = not far or float(np.mean(far)) < _STILL or float(np.mean(near)) < _FILM * float(np.mean(far))
    return is_alike and not is_slow


def _tiny(path: Path) -> np.ndarray:
    return cv2.resize(decode(path), _TINY, interpolation=cv2.INTER_AREA).mean(axis=2).astype(np.float32)
