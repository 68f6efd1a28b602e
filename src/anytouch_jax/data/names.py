"""Names of frames: the order that their numbers show, several recorders in one folder, films and
single pictures.
"""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path
from typing import Any

Number = int | Decimal

_COUNTED = {
    "frame",
    "frames",
    "frm",
    "f",
    "img",
    "image",
    "i",
    "picture",
    "pic",
    "photo",
    "shot",
    "sample",
    "step",
}
# words before the number of a frame
_COUNTED |= {"index", "idx", "no", "nr", "num", "n", "t", "time", "ts"}
# A number, also with a fraction (but not in 2024.05.01) or as Python writes small floats.
_DECIMAL = re.compile(r"((?<!\d)(?<!\d\.)\d+\.\d+(?!\.?\d)(?:e[+-]\d{2,3})?|\de[+-]\d{2,3}|\d+)")
_DATE = re.compile(
    r"(?<!\d)(?:19|20)\d\d([-_.:]?)[01]\d\1[0-3]\d[T_ -]{0,3}[0-2]\d([-_.:h]?)[0-5]\d[-_.:m]?[0-5]\d"
)
_SIDE = re.compile(
    r"\d|(?<![^\W_])(?:left|right|l|r|thumb|index|middle|ring|little|pinky)(?![^\W_])",
    re.IGNORECASE,
)


def frame_order(names: Sequence[str]) -> tuple[list[str], bool]:
    """Return the names of a folder's frames in order, series by series (`split_series`), and
    whether they show it.

    Numbers are compared by value from left to right. One that counts goes first if what stands
    before it is in no order.
    """
    ordered = list[str]()
    is_clear = True
    for series in split_series(sorted(names, key=natural)).values():
        parts = _number_parts(series)
        forms = Counter("0".join(one[::2]) for one in parts)
        values = [tuple(map(_value, one[1::2])) for one in parts]
        widths = set(map(len, values))
        texts = list(zip(*(one[1::2][len(one) // 2 - min(widths) :] for one in parts), strict=True))
        # counters stand behind
        columns = [tuple(map(_value, column)) for column in texts]
        keys: list[Any] = list(map(_natural, parts))
        if (
            is_shown := len(widths) == 1
            and len(set(values)) == len(values)
            and not _is_random(forms)
        ):
            keys = list(values)
        order = sorted(range(len(series)), key=lambda i: (keys[i], series[i]))
        for at, column in reversed(
            [(at, column) for at, column in enumerate(columns) if _counts_all(column)]
        ):
            counted = sorted(order, key=lambda i: column[i])
            is_clock = at > 0 and all(
                len(one) == 2 and one < "60" for two in texts[at - 1 : at + 1] for one in two
            )
            blocks = len(list(itertools.groupby(columns[at - 1][i] for i in counted)))
            if is_clock and 4 * blocks < len(series):
                break  # its seconds begin again
            if _is_random(forms) or not _is_rising([column[i] for i in order]):
                is_shown = True
                order = counted
            break
        ordered += [series[i] for i in order]
        is_clear &= is_shown or len(series) == 1
    return ordered, is_clear


def _is_random(forms: Counter[str]) -> bool:
    """Return whether most names have words that no other name has, as hash values have."""
    return len(forms) > 4 and 2 * list(forms.values()).count(1) > len(forms)


def _counts_all(column: Sequence[Number]) -> bool:
    """Return whether numbers are whole, distinct, and nearly without gaps: they count frames."""
    ordered = sorted(column)
    steps = [b - a for a, b in itertools.pairwise(ordered)]
    return (
        len(column) > 2
        and all(value == int(value) for value in column)
        and 5 * steps.count(1) >= 4 * len(steps)
    )


def _is_rising(column: Sequence[Any]) -> bool:
    return all(a <= b for a, b in itertools.pairwise(column))


def looks_like_film(names: Sequence[str]) -> bool:
    """Return whether names of frames, in order, may be those of a film: they count, or give times
    at a steady rate.
    """
    if len(names) < 2:
        return False
    values = [numbers for _, numbers in _series_of(names)]
    if _counted(values) is not None:
        return True
    if len({match[0] for name in names if (match := _DATE.search(name))}) == len(names):
        return False  # each in another second
    columns = list(zip(*values, strict=True)) if len(set(map(len, values))) == 1 else []
    varying = [column for column in columns if len(set(column)) > 1]
    if not varying or not _is_rising(varying[-1]):
        return False
    # of a time since 1970: s, ms, us or ns
    unit = 10 ** max(0, 3 * ((len(str(int(varying[-1][0]))) - 8) // 3))
    if varying[-1][0] > 10**9 and len({value // unit for value in varying[-1]}) == len(names):
        return False
    steps = sorted(b - a for a, b in itertools.pairwise(varying[-1]))
    middle = steps[len(steps) // 2]
    steady = sum(middle <= 2 * step and 2 * step <= 3 * middle for step in steps)
    return middle > 0 and 10 * steady >= 6 * len(steps)


def frame_numbers(names: Sequence[str]) -> list[int]:
    """Return the frames' last numbers that differ, if a third of the steps or more are 1; else
    (times) 0, 1, 2, ...
    """
    return _counted([numbers for _, numbers in _series_of(names)]) or list(range(len(names)))


def _counted(counters: Sequence[tuple[Number, ...]]) -> list[int] | None:
    """Return the last numbers that differ, if a third of their steps or more are 1 and none is
    below.
    """
    if len(set(map(len, counters))) == 1:
        columns = [column for column in zip(*counters, strict=True) if len(set(column)) > 1]
        numbers = list(columns[-1] if columns else [numbers[-1] for numbers in counters if numbers])
    else:
        numbers = [numbers[-1] for numbers in counters if numbers]
    steps = [b - a for a, b in itertools.pairwise(numbers)]
    is_count = (
        len(numbers) == len(counters)
        and min(steps, default=0) == 1
        and 3 * steps.count(1) >= len(steps)
    )
    is_whole = is_count and all(number == int(number) < 1 << 63 for number in numbers)
    if is_whole:
        return [int(number) for number in numbers]
    return None


def split_series(names: Sequence[str]) -> dict[str, list[str]]:
    """Return the names of a folder by series, if they are of several recorders; else all of them
    under "".

    left_0 and right_0 (0_A and 0_B, 0_D20012 and 0_D20345) are two fingers: they share a number. So
    are sides or serial numbers that alternate. 12-00-05 is one time.
    """
    parts = _series_of(names)
    series: dict[str, list[str]] = {}
    owners: dict[tuple[Number, ...], set[str]] = {}
    for name, (key, numbers) in zip(names, parts, strict=True):
        series.setdefault(key, []).append(name)
        owners.setdefault(numbers, set()).add(key)
    if _is_random(Counter(key for key, _ in parts)):
        return {"": list(names)}  # names without a system, such as hash values
    shared = any(numbers and len(keys) > 1 for numbers, keys in owners.items())
    in_time = [key for key, _ in sorted(parts, key=lambda part: part[1])]
    changes = sum(a != b for a, b in itertools.pairwise(in_time))
    alternate = changes > len(series) and all(_SIDE.search(key) for key in series)
    if len(series) > 1 and (shared or alternate):
        return series
    return {"": list(names)}


def _series_of(names: Sequence[str]) -> list[tuple[str, tuple[Number, ...]]]:
    """Return each name's series (its words, with serials as cam0), and its numbers that count
    frames.
    """
    forms: dict[str, list[list[str]]] = {}
    pieces = _number_parts(names)
    for one in pieces:
        forms.setdefault("0".join(one[::2]), []).append(one)
    counters = {form: _counters(alike) for form, alike in forms.items()}
    parts = []
    for one in pieces:
        at = counters["0".join(one[::2])]
        words = "".join("/" if i in at else piece for i, piece in enumerate(one)).split("/")
        key = "_".join(word for word in (word.strip(" ._-()") for word in words) if word)
        parts.append((key, tuple(_value(one[i]) for i in at)))
    return parts


def _counters(alike: list[list[str]]) -> list[int]:
    """Return which pieces of names of one form (words and numbers in turn) count frames."""
    counters: list[int] = []
    serials: list[int] = []
    for at in range(1, len(alike[0]), 2):
        word = re.search(r"[^\W\d_]+$", alike[0][at - 1])
        # In 12h05 or 01T12 the letter is between two numbers: it is no word.
        is_serial = word and (word.start() > 0 or at == 1) and word[0].lower() not in _COUNTED
        (serials if is_serial else counters).append(at)
    values = {at: len({one[at] for one in alike}) for at in (*counters, *serials)}
    most = max(reversed(serials), key=values.__getitem__, default=0)
    if most and all(values[at] == 1 for at in counters) and (not counters or values[most] > 4):
        counters.append(most)
    return sorted(counters)


def _number_parts(names: Sequence[str]) -> list[list[str]]:
    """Return words and numbers of each name in turn.

    1,5 is 1.5; in names with 1.1 and 1.10 the point separates two.
    """
    stems = [re.sub(r"(?<=\d),(?=\d)", ".", Path(name).stem) for name in names]
    fractions = [number.partition(".")[2] for stem in stems for number in _DECIMAL.findall(stem)]
    is_dotted = len(set(map(len, fractions))) > 1 and any(
        len(one) > 1 and one[-1] == "0" for one in fractions
    )
    pattern = re.compile(r"(\d+)") if is_dotted else _DECIMAL
    return [pattern.split(stem) for stem in stems]


def _value(number: str) -> Number:
    """Return a number by value. Its digits may be those of any script."""
    if number.isdecimal():
        return int(number)
    return Decimal(number)


def _natural(parts: Sequence[str]) -> list[tuple[Number, str]]:
    """Return a sort key of words and numbers in turn that compares numbers by value."""
    return [
        (_value(part), "") if at % 2 else (-1, part)
        for at, part in enumerate(parts)
        if at % 2 or part
    ]


def natural(name: str) -> list[tuple[Number, str]]:
    """Return a sort key that puts 2 before 10."""
    return _natural(re.split(r"(\d+)", name))
