"""Names of frames: the order that their numbers show, several recorders, videos and stills."""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path
from typing import Any

Number = int | Decimal
# Words and numbers of a name in turn, words first: "left_12.5" is ["left_", "12.5", ""].
Pieces = list[str]

# Words before the number of a frame. A number after another word, as in cam0, names a device.
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
    "index",
    "idx",
    "no",
    "nr",
    "num",
    "n",
    "t",
    "time",
    "ts",
}
# A number, also with a fraction (but not in 2024.05.01) or as Python writes small floats.
_DECIMAL = re.compile(r"((?<!\d)(?<!\d\.)\d+\.\d+(?!\.?\d)(?:e[+-]\d{2,3})?|\de[+-]\d{2,3}|\d+)")
# A day and a time of day, with or without signs between the parts.
_DATE = re.compile(
    r"(?<!\d)(?:19|20)\d\d([-_.:]?)[01]\d\1[0-3]\d"
    r"[T_ -]{0,3}"
    r"[0-2]\d([-_.:h]?)[0-5]\d[-_.:m]?[0-5]\d"
)
# What tells two recorders apart: a number, or a side of the hand.
_SIDE = re.compile(
    r"\d|(?<![^\W_])(?:left|right|l|r|thumb|index|middle|ring|little|pinky)(?![^\W_])",
    re.IGNORECASE,
)


def frame_order(names: Sequence[str]) -> tuple[list[str], bool]:
    """Return the names of a folder's frames in order, and whether they show it.

    Several series in one folder come one after another (`split_series`). Within one, numbers are
    compared by value from left to right. One that counts goes first if what stands before it is in
    no order.
    """
    ordered = list[str]()
    is_clear = True
    for series in split_series(sorted(names, key=natural)).values():
        in_order, is_shown = _series_order(series)
        ordered += in_order
        is_clear &= is_shown or len(series) == 1
    return ordered, is_clear


def _series_order(series: Sequence[str]) -> tuple[list[str], bool]:
    """Return the names of one series in order, and whether they show it."""
    parts = _number_parts(series)
    is_random = _is_random(Counter(_form(one) for one in parts))
    values = [tuple(map(_value, one[1::2])) for one in parts]
    counts = {len(numbers) for numbers in values}
    # Names of one form with distinct numbers: these decide, and the words do not.
    is_shown = len(counts) == 1 and len(set(values)) == len(values) and not is_random
    keys: list[Any] = list(values) if is_shown else list(map(_natural, parts))
    order = sorted(range(len(series)), key=lambda i: (keys[i], series[i]))

    # Some names may have numbers more at their start. The last numbers of all names are compared,
    # because counters stand behind.
    fewest = min(counts, default=0)
    texts = [one[1::2][len(one) // 2 - fewest :] for one in parts]
    columns = [tuple(map(_value, column)) for column in zip(*texts, strict=True)]
    for at in reversed(range(len(columns))):
        column = columns[at]
        if not _counts_all(column):
            continue
        counted = sorted(order, key=lambda i: column[i])
        if at > 0 and _is_clock([text[at - 1 : at + 1] for text in texts]):
            minutes = [columns[at - 1][i] for i in counted]
            blocks = len(list(itertools.groupby(minutes)))
            if 4 * blocks < len(series):
                break  # these seconds begin again with each minute
        if is_random or not _is_rising([column[i] for i in order]):
            is_shown = True
            order = counted
        break
    return [series[i] for i in order], is_shown


def _is_clock(texts: Sequence[Sequence[str]]) -> bool:
    """Return whether neighbouring numbers have two digits below 60, as minutes and seconds have."""
    numbers = itertools.chain.from_iterable(texts)
    return all(len(number) == 2 and number < "60" for number in numbers)


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


def looks_like_video(names: Sequence[str]) -> bool:
    """Return whether names of frames, in order, may be those of a video.

    They are if they count, or give times at a steady rate.
    """
    if len(names) < 2:
        return False
    values = [numbers for _, numbers in _series_of(names)]
    if _counted(values) is not None:
        return True
    dates = [_DATE.search(name) for name in names]
    if len({match[0] for match in dates if match}) == len(names):
        return False  # each in another second
    columns = []
    if len(set(map(len, values))) == 1:
        columns = [column for column in zip(*values, strict=True) if len(set(column)) > 1]
    if not columns or not _is_rising(columns[-1]):
        return False
    times = columns[-1]
    # Of a time since 1970, in s, ms, us or ns: a second in that unit.
    second = 10 ** max(0, 3 * ((len(str(int(times[0]))) - 8) // 3))
    is_since_1970 = times[0] > 10**9
    if is_since_1970 and len({value // second for value in times}) == len(names):
        return False
    steps = sorted(b - a for a, b in itertools.pairwise(times))
    middle = steps[len(steps) // 2]
    # Within a factor of two below and one and a half above: a camera that drops some frames.
    steady = sum(middle <= 2 * step and 2 * step <= 3 * middle for step in steps)
    return middle > 0 and 10 * steady >= 6 * len(steps)


def frame_numbers(names: Sequence[str]) -> list[int]:
    """Return the numbers of frames by their names, or 0, 1, 2, ... if the names give times.

    They are the last numbers that differ, if a third of their steps or more are 1.
    """
    return _counted([numbers for _, numbers in _series_of(names)]) or list(range(len(names)))


def _counted(counters: Sequence[tuple[Number, ...]]) -> list[int] | None:
    """Return the last numbers that differ, if a third of their steps or more are 1, none below."""
    numbers = [numbers[-1] for numbers in counters if numbers]
    if len(set(map(len, counters))) == 1:
        varying = [column for column in zip(*counters, strict=True) if len(set(column)) > 1]
        if varying:
            numbers = list(varying[-1])
    steps = [b - a for a, b in itertools.pairwise(numbers)]
    is_count = (
        len(numbers) == len(counters)
        and min(steps, default=0) == 1
        and 3 * steps.count(1) >= len(steps)
    )
    # The column frame_index has 64 bits.
    if is_count and all(number == int(number) < 1 << 63 for number in numbers):
        return [int(number) for number in numbers]
    return None


def split_series(names: Sequence[str]) -> dict[str, list[str]]:
    """Return the names of a folder by series, if they are of several recorders; else all under "".

    left_0 and right_0 (0_A and 0_B, 0_D20012 and 0_D20345) are two fingers, because they share a
    number. So are sides or serial numbers that alternate. 12-00-05 is one time.
    """
    parts = _series_of(names)
    if _is_random(Counter(key for key, _ in parts)):
        return {"": list(names)}  # names without a system, such as hash values
    series: dict[str, list[str]] = {}
    owners: dict[tuple[Number, ...], set[str]] = {}
    for name, (key, numbers) in zip(names, parts, strict=True):
        series.setdefault(key, []).append(name)
        owners.setdefault(numbers, set()).add(key)
    fraction_numbers = any(numbers and len(keys) > 1 for numbers, keys in owners.items())
    in_time = [key for key, _ in sorted(parts, key=lambda part: part[1])]
    changes = sum(a != b for a, b in itertools.pairwise(in_time))
    alternate = changes > len(series) and all(_SIDE.search(key) for key in series)
    if len(series) > 1 and (fraction_numbers or alternate):
        return series
    return {"": list(names)}


def _series_of(names: Sequence[str]) -> list[tuple[str, tuple[Number, ...]]]:
    """Return each name's series (its words, with serials as cam0), and its numbers that count."""
    pieces = _number_parts(names)
    forms: dict[str, list[Pieces]] = {}
    for one in pieces:
        forms.setdefault(_form(one), []).append(one)
    counters = {form: _counters(alike) for form, alike in forms.items()}
    parts = []
    for one in pieces:
        at = counters[_form(one)]
        # A slash, which no name has, stands where a counter was.
        words = "".join("/" if i in at else piece for i, piece in enumerate(one)).split("/")
        stripped = [word.strip(" ._-()") for word in words]
        key = "_".join(word for word in stripped if word)
        parts.append((key, tuple(_value(one[i]) for i in at)))
    return parts


def _form(pieces: Pieces) -> str:
    """Return the words of a name with 0 for each number."""
    return "0".join(pieces[::2])


def _counters(alike: list[Pieces]) -> list[int]:
    """Return which pieces of names of one form count frames."""
    counters: list[int] = []
    serials: list[int] = []
    for at in range(1, len(alike[0]), 2):
        word = re.search(r"[^\W\d_]+$", alike[0][at - 1])
        # In 12h05 or 01T12 the letter is between two numbers: it is no word.
        is_word = word is not None and (word.start() > 0 or at == 1)
        if word is not None and is_word and word[0].lower() not in _COUNTED:
            serials.append(at)
        else:
            counters.append(at)
    values = {at: len({one[at] for one in alike}) for at in (*counters, *serials)}
    # Where nothing else varies, the serial with the most values counts after all: touch12.
    most = max(reversed(serials), key=values.__getitem__, default=0)
    if most and all(values[at] == 1 for at in counters) and (not counters or values[most] > 4):
        counters.append(most)
    return sorted(counters)


def _number_parts(names: Sequence[str]) -> list[Pieces]:
    """Return words and numbers of each name in turn.

    1,5 is 1.5. In names with 1.1 and 1.10 the point separates two numbers.
    """
    stems = [re.sub(r"(?<=\d),(?=\d)", ".", Path(name).stem) for name in names]
    fractions = [number.partition(".")[2] for stem in stems for number in _DECIMAL.findall(stem)]
    # Nobody writes a fraction with zeros behind and others without: these count.
    has_lengths = len(set(map(len, fractions))) > 1
    has_zeros = any(len(one) > 1 and one[-1] == "0" for one in fractions)
    pattern = re.compile(r"(\d+)") if has_lengths and has_zeros else _DECIMAL
    return [pattern.split(stem) for stem in stems]


def _value(number: str) -> Number:
    """Return a number by value. Its digits may be those of any script."""
    if number.isdecimal():
        return int(number)
    return Decimal(number)


def _natural(pieces: Sequence[str]) -> list[tuple[Number, str]]:
    """Return a sort key of words and numbers in turn that compares numbers by value."""
    key: list[tuple[Number, str]] = []
    for at, piece in enumerate(pieces):
        if at % 2:
            key.append((_value(piece), ""))
        elif piece:
            # words come before numbers
            key.append((-1, piece))
    return key


def natural(name: str) -> list[tuple[Number, str]]:
    """Return a sort key that puts 2 before 10."""
    return _natural(re.split(r"(\d+)", name))
