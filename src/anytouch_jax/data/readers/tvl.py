"""TVL's human-collected part, HCT (Fu et al., ICML 2024): a hand-held DIGIT and a camera.

Layout (the dataset's card): `hct/data{1,2,3}/<recording>/{tactile,vision}/<id>-<time>.jpg`, with `contact.json`,
`not_contact.json`, `train.csv` and `test.csv` in each `data<k>`. In the authors' loader the JSON files hold equally
long lists `tactile`, `vision`, `background` of paths below `data<k>`, and a missing background means
`data<k>/digit_background.png`. The CSV files have the columns tactile and caption (T3). Code is Apache-2.0. No licence
of the data was found.

* Some recordings have the two folders swapped (reported to the authors, who point to a corrected copy). They are
  swapped back if that is certain: by the declared size (a DIGIT gives 240 x 320), else by similarity to the other
  recordings' touch. Two pictures of each recording are opened for this, and no others.
* The vision frame has the touch frame's name. Frames are matched by their whole number, never by a string prefix.
* Frames in no contact list of a `data<k>` that has one are background (label.contact 0).
* The split is that of test.csv, by frame. A recording's test frames are a separate sequence. Without the CSV files the
  split is by hash of the recording.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from anytouch_jax.data.images import ImageError, decode
from anytouch_jax.data.readers.common import DatasetError, DatasetIndex, DatasetReader, Frames, read_json, read_table

PARTS = ("data1", "data2", "data3")
FRAME = r"(\d+)-[\d.e+-]+\.(?:jpe?g|png)"
TOUCH_SIZE = {240, 320}  # a DIGIT's picture, upright or lying
THUMB = 16
MARGIN = 0.3  # correlation by which vision must be more similar to touch than touch is
Sides = dict[str, Frames]  # "tactile" and "vision" -> frames


def read(index: DatasetIndex) -> None:
    """Add every recording of data1, data2, data3. Raises DatasetError if none of them exists."""
    base = index.find_folder("tvl_dataset/hct", "hct", ".", inside=PARTS)
    parts = [part for part in PARTS if (base / part).is_dir()]
    places = [f"{part}/{name}" for part in parts for name in index.listing(base / part)[0]]
    recordings = {place: sides for place in places if (sides := _sides(index, base, place)) is not None}
    first = {
        place: tuple(base / place / side / frames[0][1] for side, frames in sides.items() if frames)
        for place, sides in recordings.items()
        if all(sides.values())
    }
    swapped = _swapped(first)
    for place in sorted(swapped):
        reason = "recording with tactile and vision swapped (read the other way round)"
        index.skip(reason, f"{index.prefix(base)}{place}")
    for part in parts:
        mine = {place: sides for place, sides in recordings.items() if place.startswith(f"{part}/")}
        _add_part(index, base / part, index.prefix(base), mine, swapped)


def _sides(index: DatasetIndex, base: Path, place: str) -> Sides | None:
    folders = index.listing(base / place)[0]
    if "tactile" not in folders:
        index.skip("recording without a folder 'tactile'", place)
        return None
    sides = ("tactile", "vision") if "vision" in folders else ("tactile",)
    return {side: index.numbered(index.listing(base / place / side)[1], FRAME, f"{place}/{side}") for side in sides}


def _add_part(index: DatasetIndex, folder: Path, prefix: str, recordings: dict[str, Sides], swapped: set[str]) -> None:
    contact, backgrounds = _contact(index, folder)
    tests, captions = _tables(index, folder)
    spare = folder / "digit_background.png"
    default = f"{prefix}{folder.name}/{spare.name}" if spare.is_file() else None
    contact_rows = 0
    touch_names = {
        place: {name for _, name in sides.get("vision" if place in swapped else "tactile", [])}
        for place, sides in recordings.items()
    }
    for place, sides in recordings.items():
        touch, vision = ("vision", "tactile") if place in swapped else ("tactile", "vision")
        frames, photos = sides.get(touch, []), {name for _, name in sides.get(vision, [])}
        recording = place.split("/", 1)[1]
        keys = [f"{recording}/{name}" for _, name in frames]
        is_contact = [None if contact is None else key in contact for key in keys]
        contact_rows += sum(map(bool, is_contact))
        index.skip("photograph missing (kept without)", place, sum(name not in photos for _, name in frames))
        if tests or captions:
            parts = ["test" if key in tests else "train" for key in keys]
        else:
            parts = [index.split_of(place)] * len(keys)
        split = ["background" if c is False else part for c, part in zip(is_contact, parts, strict=True)]
        named = [backgrounds.get(key) for key in keys]
        on_disk = [_background(path, touch_names, swapped, folder.name, prefix) for path in named]
        missing = [
            path
            for path, file in zip(named, on_disk, strict=True)
            if path and file is None and not (default and Path(path).name == spare.name)
        ]
        instead = f"{spare.name} instead" if default else "kept without"
        example = f"{folder.name}/{next(iter(missing), '')}"
        index.skip(f"background named and not on disk ({instead})", example, len(missing))
        index.add(
            [f"{prefix}{place}/{touch}/{name}" for _, name in frames],
            sensor="digit",
            sequence=[f"{place}/test" if part == "test" and tests else place for part in split],
            frame_index=[number for number, _ in frames],
            split=split,
            image_path=[f"{prefix}{place}/{vision}/{name}" if name in photos else None for _, name in frames],
            background_path=[path or default for path in on_disk],
            text=[captions.get(key) for key in keys],
            **{"label.contact": [None if c is None else int(c) for c in is_contact]},
        )
    index.skip("listed contact frame that is not on disk", str(folder), len(contact) - contact_rows if contact else 0)


def _background(
    path: str | None, touch_names: dict[str, set[str]], swapped: set[str], part: str, prefix: str
) -> str | None:
    """Return the background named in contact.json, in the folder that holds touch, if it is a frame on disk."""
    match = re.fullmatch(r"([^/]+)/(?:tactile|vision)/([^/]+)", path or "")
    if not match:
        return None
    place = f"{part}/{match[1]}"
    side = "vision" if place in swapped else "tactile"
    return f"{prefix}{place}/{side}/{match[2]}" if match[2] in touch_names.get(place, ()) else None


def _key(path: str) -> str:
    """Return recording/name of recording/tactile/name, so that swapped folders have the same key."""
    parts = path.replace("\\", "/").split("/")
    return f"{parts[-3]}/{parts[-1]}" if len(parts) > 2 else path


def _contact(index: DatasetIndex, folder: Path) -> tuple[set[str] | None, dict[str, str]]:
    """Return the keys of contact frames (None: unknown), and their backgrounds."""
    path = folder / "contact.json"
    if not path.is_file():
        index.notes.append(f"no {folder.name}/contact.json: which of its frames are contact is not known")
        return None, {}
    table = read_json(path)
    touch, backgrounds = table.get("tactile"), table.get("background", [])
    if not all(isinstance(paths, list) and set(map(type, paths)) <= {str} for paths in (touch, backgrounds)):
        raise DatasetError(f"{path}: expected a list 'tactile' of contact frames, and a list 'background' or none")
    assert touch is not None
    keys = [_key(name) for name in touch]
    return set(keys), dict(zip(keys, backgrounds, strict=False))


def _tables(index: DatasetIndex, folder: Path) -> tuple[set[str], dict[str, str]]:
    """Return the frames of the test table, and the captions of both tables."""
    tests: set[str] = set()
    captions: dict[str, str] = {}
    for split in ("train", "test"):
        path = folder / f"{split}.csv"
        if not path.is_file():
            index.notes.append(f"no {folder.name}/{split}.csv: no captions and no test frames of it")
            continue
        for row in read_table(path, "tactile"):
            key = _key(row["tactile"])
            if row.get("caption"):
                captions[key] = row["caption"]
            if split == "test":
                tests.add(key)
    return tests, captions


def _swapped(first: Mapping[str, tuple[Path, ...]]) -> set[str]:
    """Return the recordings whose pictures (touch, vision) are swapped; `first`: one picture of each.

    They are known by size, if only one of the two has a DIGIT's. Otherwise the median of all touch pictures of unclear
    recordings stands for touch: a recording is swapped if its vision correlates with it better by MARGIN than its
    touch. A recording whose pictures cannot be read stays unchanged.
    """
    thumbs, swapped, unclear = {}, set(), []
    for name, (touch, vision) in first.items():
        try:
            pictures = decode(touch), decode(vision)
        except ImageError:
            continue
        is_touch = [set(picture.shape[:2]) == TOUCH_SIZE for picture in pictures]
        if is_touch == [False, True]:
            swapped.add(name)
        elif is_touch != [True, False]:
            unclear.append(name)
            thumbs[name] = tuple(_thumb(picture) for picture in pictures)
    if len(unclear) < 3:
        return swapped  # two recordings have no majority
    median = np.median([thumbs[name][0] for name in unclear], axis=0).ravel()
    for name in unclear:
        similarity = [float(np.corrcoef(median, thumb.ravel())[0, 1]) for thumb in thumbs[name]]
        if similarity[1] > similarity[0] + MARGIN:
            swapped.add(name)
    return swapped


def _thumb(picture: np.ndarray) -> np.ndarray:
    """Return means over THUMB x THUMB cells of a lying picture, f32, with a faint ramp so that no picture is flat."""
    if picture.shape[0] > picture.shape[1]:
        picture = np.rot90(picture)
    rows = np.linspace(0, picture.shape[0] - 1, THUMB * 4).astype(int)
    cols = np.linspace(0, picture.shape[1] - 1, THUMB * 4).astype(int)
    cells = picture[rows][:, cols].astype(np.float32).reshape(THUMB, 4, THUMB, 4, 3).mean(axis=(1, 3))
    return cells + np.linspace(0, 1e-3, cells.size, dtype=np.float32).reshape(cells.shape)


READER = DatasetReader(
    read,
    url="https://huggingface.co/datasets/mlfu7/Touch-Vision-Language-Dataset",
    citation="Fu et al., A Touch, Vision, and Language Dataset for Multimodal Alignment, ICML 2024",
    paper=39_000,
)
