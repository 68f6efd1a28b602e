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

from anytouch_jax.data.readers.common import DatasetError, DatasetIndex, DatasetReader, read_lines

SENSORS = {"gelsight": "gelsight_mini", "digit": "digit", "duragel": "duragel"}
COARSE = ("indoor", "outdoor")
ON_DISK = {"shuttlecock": "yumaoqiu"}  # folder -> its name in the list, the Chinese word


def read(index: DatasetIndex) -> None:
    """Add every item of every `data_*` subset. Raises DatasetError for one without its contact list."""
    subsets = [name.removeprefix("data_") for name in index.listing("")[0] if name.startswith("data_")]
    index.notes += [f"no data_{subset}: that subset is left out" for subset in COARSE if subset not in subsets]
    for subset in subsets:
        contact = _contact_spans(index, subset)
        for item in index.tracked(index.listing(f"data_{subset}")[0]):
            place = f"data_{subset}/{item}"
            listed = item if item in contact else ON_DISK.get(item, item)
            if listed not in contact:
                index.skip(f"item that is not in contact_{subset}.csv", place)
                continue
            if listed != item:
                index.notes.append(f"{place} is {listed!r} in contact_{subset}.csv: its lines are used")
            number, spans = contact.pop(listed)
            split = index.split_of(item) if subset in COARSE else "unused"
            cells = {"object": item, "touch": f"{subset}/{item}", "subset": subset, "split": split,
                     "caption_id": f"tacquad_{subset}_{number}"}  # fmt: skip
            _add_item(index, place, spans, cells)
        for item in contact:
            index.skip(f"item of contact_{subset}.csv that is not on disk", f"data_{subset}/{item}")


def _contact_spans(index: DatasetIndex, subset: str) -> dict[str, tuple[int, list[tuple[int, int]]]]:
    """Return item -> its number in the list (from 0) and (first, last contact frame) of each sensor."""
    path = index.find_file([f"contact_{subset}.csv"])
    if path is None:
        place = index.options.lists or index.root
        raise DatasetError(f"expected the list contact_{subset}.csv in {place}, next to data_{subset}")
    spans: dict[str, tuple[int, list[tuple[int, int]]]] = {}
    for number, (line, row) in enumerate(read_lines(path)):
        try:
            ends = [int(cell) for cell in row[1 : 2 * len(SENSORS) + 1]]
            if len(ends) != 2 * len(SENSORS) or row[0] in spans:
                raise ValueError
        except ValueError:
            raise DatasetError(f"{path}, line {line}: expected a new item and six frame numbers, "
                               f"found {','.join(row)}") from None  # fmt: skip
        spans[row[0]] = number, list(zip(ends[::2], ends[1::2], strict=True))
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
        frames = index.frames(path)
        contact = [first <= number <= last for number in frames]
        index.skip("contact frame that is not on disk", path, max(last - first + 1, 0) - sum(contact))
        start, free = min(frames, default=0), "unused" if cells["split"] == "unused" else "background"
        photos = index.frames(f"{place}/img_{folder}")  # of the same fraction of the recording; numbers may have gaps
        most, length = max(photos, default=-1) + 1, max(frames, default=0) + 1
        names = [photos.get(number * most // length, "") for number in frames]
        index.add(
            [f"{path}/{name}" for name in frames.values()],
            sensor=sensor,
            sequence=path,
            frame_index=list(frames),
            image_path=index.photographs(f"{place}/img_{folder}", names, set(photos.values())),
            background_path=f"{path}/{frames[start]}" if frames and start < first and not contact[0] else None,
            **cells | {"split": [cells["split"] if touched else free for touched in contact],
                       "label.contact": [int(touched) for touched in contact]},
        )  # fmt: skip


READERS = {
    "tacquad": DatasetReader(
        read,
        "data_indoor/<item>/gelsight/0.png",
        "Feng et al., AnyTouch: Learning Unified Static-Dynamic Representation across Multiple Visuo-tactile Sensors, "
        "ICLR 2025",
        url="https://huggingface.co/datasets/xxuan01/TacQuad",
        uses=("val", "test", "lists"),
        paper=55_082,
        paper_note="coarse; 17,524 fine; both with Tac3D",
    )
}
