"""TacQuad (Feng et al., ICLR 2025): the same place of the same object touched with four sensors.

Seen in AnyTouch's loaders: `data_{indoor,outdoor}/<item>/{gelsight,digit,duragel}/<n>.png` (`gelsight` is the
GelSight Mini), the photographs in `img_{gelsight,digit,duragel}/<n>.png`, and `contact_{indoor,outdoor}.csv` without
header: item, then first and last contact frame of gelsight, digit, duragel. Assumed: the fine subset is laid out
alike (`data_fine`, `contact_fine.csv`); further columns of the CSV are Tac3D's. The layout of Tac3D's force fields
was not seen: they are counted and left out. No data licence was found.

* Contact frames get the item's split, the others `background` (label.contact 0); the first frame of a recording is
  its background where contact begins later.
* `touch` is the item, equal for all sensors; the photograph is that of the same fraction of the recording.
* The fine subset is `unused`: the paper keeps it for cross-sensor generation.
* `caption_id` is the name of the item's caption in the authors' download: its line in the CSV.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from anytouch_jax.data.readers.common import (
    Columns,
    DatasetError,
    DatasetReader,
    IndexOptions,
    Notes,
    RowBuilder,
    find_file,
    hash_split,
    listing,
    numbered,
    read_csv,
)

SENSORS = {"gelsight": "gelsight_mini", "digit": "digit", "duragel": "duragel"}
KEPT = ("indoor", "outdoor")


def read(root: Path, options: IndexOptions, notes: Notes) -> Columns:
    """Every item of every `data_*` subset. Raises DatasetError without one, or without its contact list."""
    subsets = [name for name in listing(root, notes)[0] if name.startswith("data_")]
    if not subsets:
        raise DatasetError(f"expected data_indoor/<item>/gelsight under {root}; is ROOT the folder that holds "
                           "'data_indoor'?")  # fmt: skip
    for subset in KEPT:
        if f"data_{subset}" not in subsets:
            notes.log(f"no data_{subset}: that subset is left out")
    rows = RowBuilder("object", "touch", "image_path", "background_path", "caption_id", "label.contact", "subset")
    for folder in subsets:
        subset = folder.removeprefix("data_")
        windows = _windows(root, subset, options)
        for item in listing(root / folder, notes)[0]:
            if item not in windows:
                notes.skip(f"item that is not in contact_{subset}.csv", f"{folder}/{item}")
                continue
            line, spans = windows.pop(item)
            split = hash_split("tacquad", item, options) if subset in KEPT else "unused"
            cells = {"object": item, "touch": f"{subset}/{item}", "subset": subset, "split": split,
                     "caption_id": f"tacquad_{subset}_{line}"}  # fmt: skip
            _item(rows, notes, root, f"{folder}/{item}", spans, cells)
        for item in windows:
            notes.skip(f"item of contact_{subset}.csv that is not on disk", f"{folder}/{item}")
    return rows.columns()


def _windows(root: Path, subset: str, options: IndexOptions) -> dict[str, tuple[int, list[tuple[int, int]]]]:
    """item -> its line in the list (from 0) and (first, last contact frame) of each sensor."""
    path = find_file([f"contact_{subset}.csv"], options.lists, root)
    if path is None:
        raise DatasetError(f"expected the list contact_{subset}.csv in {options.lists or root}, beside data_{subset}")
    windows: dict[str, tuple[int, list[tuple[int, int]]]] = {}
    for line, row in enumerate(read_csv(path)):
        try:
            ends = [int(cell) for cell in row[1 : 2 * len(SENSORS) + 1]]
            if len(ends) != 2 * len(SENSORS) or row[0] in windows:
                raise ValueError
        except ValueError:
            raise DatasetError(f"{path}, line {line + 1}: expected a new item and six frame numbers, "
                               f"found {','.join(row)}") from None  # fmt: skip
        windows[row[0]] = line, list(zip(ends[::2], ends[1::2], strict=True))
    return windows


def _item(rows: RowBuilder, notes: Notes, root: Path, place: str, spans: list[tuple[int, int]],
          cells: dict[str, Any]) -> None:  # fmt: skip
    folders = listing(root / place, notes)[0]
    for folder in folders:
        if folder not in SENSORS and folder.removeprefix("img_") not in SENSORS:
            notes.skip(f"folder {folder!r} (no sensor with images)", f"{place}/{folder}")
    for (folder, sensor), (first, last) in zip(SENSORS.items(), spans, strict=True):
        if folder not in folders:
            notes.skip("item without a sensor", f"{place}/{folder}")
            continue
        here = f"{place}/{folder}"
        frames = numbered(listing(root / here, notes)[1], r"(\d+)\.(?:png|jpe?g)", notes, here)
        numbers = [number for number, _ in frames]
        contact = [first <= number <= last for number in numbers]
        notes.skip("contact frame that is not on disk", here, max(last - first + 1, 0) - sum(contact))
        free = frames and not contact[0] and numbers[0] < first
        split = [cells["split"] if one or cells["split"] == "unused" else "background" for one in contact]
        rows.add(
            [f"{here}/{name}" for _, name in frames],
            sensor=sensor,
            sequence=here,
            frame_index=numbers,
            image_path=_photos(notes, root, f"{place}/img_{folder}", numbers),
            background_path=f"{here}/{frames[0][1]}" if free else None,
            **cells | {"split": split, "label.contact": [int(one) for one in contact]},
        )


def _photos(notes: Notes, root: Path, folder: str, numbers: list[int]) -> list[str | None]:
    """The photograph at the same fraction of the recording: floor(n / touch frames x photographs)."""
    files = listing(root / folder, notes)[1] if (root / folder).is_dir() else []
    photos = dict(numbered(files, r"(\d+)\.(?:png|jpe?g)", notes, folder))
    at = [n * len(photos) // len(numbers) for n in numbers]
    found = [f"{folder}/{photos[n]}" if n in photos else None for n in at]
    notes.skip("photograph missing (kept without)", folder, found.count(None))
    return found


READER = DatasetReader(
    name="tacquad",
    read=read,
    sensor="gelsight_mini, digit, duragel",
    license="not stated",
    commercial=False,
    about="the same places touched with four sensors, with photographs; fine and coarse alignment",
    url="https://huggingface.co/datasets/xxuan01/TacQuad",
    citation="Feng et al., AnyTouch: Learning Unified Static-Dynamic Representation across Multiple Visuo-tactile "
    "Sensors, ICLR 2025",
    uses=("val", "test", "lists"),
    paper=55_082,
    paper_note="coarse; 17,524 fine; both with Tac3D",
)
