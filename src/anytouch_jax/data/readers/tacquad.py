"""TacQuad (Feng et al., ICLR 2025): the same place of the same object touched with four sensors.

Layout in AnyTouch's loaders: `data_{indoor,outdoor}/<item>/{gelsight,digit,duragel}/<n>.png` (`gelsight` is the
GelSight Mini), photographs in `img_{gelsight,digit,duragel}/<n>.png`, and `contact_{indoor,outdoor}.csv` without
header: item, then first and last contact frame of gelsight, digit, duragel. Assumed: the fine subset has the same
layout (`data_fine`, `contact_fine.csv`), and further columns of the CSV are Tac3D's. The layout of Tac3D's force
fields is unknown: they are counted and left out. No data licence was found.

* Contact frames get the item's split, the others `background` (label.contact 0). The first frame of a recording is
  its background if contact begins later.
* One item of the indoor list has another name on disk (ON_DISK).
* `touch` is the item, equal for all sensors. The photograph is that of the same fraction of the recording.
* The fine subset is `unused`: the paper reserves it for cross-sensor generation.
* `caption_id` is the name of the item's caption in the authors' download: its line in the CSV.
"""

from __future__ import annotations

from typing import Any

from anytouch_jax.data.readers.common import DatasetError, DatasetIndex, DatasetReader, read_csv

SENSORS = {"gelsight": "gelsight_mini", "digit": "digit", "duragel": "duragel"}
COARSE = ("indoor", "outdoor")
ON_DISK = {"shuttlecock": "yumaoqiu"}  # folder -> its name in the list, the Chinese word


def read(index: DatasetIndex) -> None:
    """Add every item of every `data_*` subset. Raises DatasetError without one, or without its contact list."""
    subsets = [name for name in index.listing(index.root)[0] if name.startswith("data_")]
    if not subsets:
        raise DatasetError(f"expected data_indoor/<item>/gelsight under {index.root}; is ROOT the folder that holds "
                           "'data_indoor'?")  # fmt: skip
    for subset in COARSE:
        if f"data_{subset}" not in subsets:
            index.notes.append(f"no data_{subset}: that subset is left out")
    for folder in subsets:
        subset = folder.removeprefix("data_")
        contact = _contact_spans(index, subset)
        for item in index.listing(folder)[0]:
            listed = item if item in contact else ON_DISK.get(item, item)
            if listed not in contact:
                index.skip(f"item that is not in contact_{subset}.csv", f"{folder}/{item}")
                continue
            if listed != item:
                index.notes.append(f"{folder}/{item} is {listed!r} in contact_{subset}.csv: its lines are used")
            line, spans = contact.pop(listed)
            split = index.split_of(item) if subset in COARSE else "unused"
            cells = {"object": item, "touch": f"{subset}/{item}", "subset": subset, "split": split,
                     "caption_id": f"tacquad_{subset}_{line}"}  # fmt: skip
            _add_item(index, f"{folder}/{item}", spans, cells)
        for item in contact:
            index.skip(f"item of contact_{subset}.csv that is not on disk", f"{folder}/{item}")


def _contact_spans(index: DatasetIndex, subset: str) -> dict[str, tuple[int, list[tuple[int, int]]]]:
    """Return item -> its line in the list (from 0) and (first, last contact frame) of each sensor."""
    path = index.find_file([f"contact_{subset}.csv"])
    if path is None:
        place = index.options.lists or index.root
        raise DatasetError(f"expected the list contact_{subset}.csv in {place}, next to data_{subset}")
    spans: dict[str, tuple[int, list[tuple[int, int]]]] = {}
    for line, row in enumerate(read_csv(path)):
        try:
            ends = [int(cell) for cell in row[1 : 2 * len(SENSORS) + 1]]
            if len(ends) != 2 * len(SENSORS) or row[0] in spans:
                raise ValueError
        except ValueError:
            raise DatasetError(f"{path}, line {line + 1}: expected a new item and six frame numbers, "
                               f"found {','.join(row)}") from None  # fmt: skip
        spans[row[0]] = line, list(zip(ends[::2], ends[1::2], strict=True))
    return spans


def _add_item(index: DatasetIndex, place: str, spans: list[tuple[int, int]], cells: dict[str, Any]) -> None:
    folders = index.listing(place)[0]
    for folder in folders:
        if folder.removeprefix("img_") not in SENSORS:
            index.skip(f"folder {folder!r} (no sensor with images)", f"{place}/{folder}")
    for (folder, sensor), (first, last) in zip(SENSORS.items(), spans, strict=True):
        path = f"{place}/{folder}"
        if folder not in folders:
            index.skip("item without a sensor", path)
            continue
        frames = index.numbered(index.listing(path)[1], r"(\d+)\.(?:png|jpe?g)", path)
        numbers = [number for number, _ in frames]
        contact = [first <= number <= last for number in numbers]
        index.skip("contact frame that is not on disk", path, max(last - first + 1, 0) - sum(contact))
        has_background = frames and not contact[0] and numbers[0] < first
        is_unused = cells["split"] == "unused"
        split = [cells["split"] if touched or is_unused else "background" for touched in contact]
        index.add(
            [f"{path}/{name}" for _, name in frames],
            sensor=sensor,
            sequence=path,
            frame_index=numbers,
            image_path=_photos(index, f"{place}/img_{folder}", numbers),
            background_path=f"{path}/{frames[0][1]}" if has_background else None,
            **cells | {"split": split, "label.contact": [int(touched) for touched in contact]},
        )


def _photos(index: DatasetIndex, folder: str, numbers: list[int]) -> list[str | None]:
    """Return the photograph at the same fraction of the recording: floor(n / touch frames x photographs)."""
    files = index.listing(folder)[1] if (index.root / folder).is_dir() else []
    photos = dict(index.numbered(files, r"(\d+)\.(?:png|jpe?g)", folder))
    wanted = [n * len(photos) // len(numbers) for n in numbers]
    paths = [f"{folder}/{photos[n]}" if n in photos else None for n in wanted]
    index.skip("photograph missing (kept without)", folder, paths.count(None))
    return paths


READER = DatasetReader(
    read,
    url="https://huggingface.co/datasets/xxuan01/TacQuad",
    citation="Feng et al., AnyTouch: Learning Unified Static-Dynamic Representation across Multiple Visuo-tactile "
    "Sensors, ICLR 2025",
    uses=("val", "test", "lists"),
    paper=55_082,
    paper_note="coarse; 17,524 fine; both with Tac3D",
)
