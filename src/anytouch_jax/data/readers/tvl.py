"""TVL's human-collected part, HCT (Fu et al., ICML 2024): a hand-held DIGIT and a camera.

Seen: the dataset's card: `hct/data{1,2,3}/<recording>/{tactile,vision}/<id>-<time>.jpg`, with `contact.json`,
`not_contact.json`, `train.csv`, `test.csv` beside the recordings; the authors' loader: the JSON files hold equally long
lists `tactile`, `vision`, `background` of paths below `data<k>`, and a missing background means
`data<k>/digit_background.png`; the CSV files have the columns tactile and caption (T3). Code is Apache-2.0; no licence
of the data was found.

* Some recordings have the two folders swapped (reported to the authors, who point to a corrected copy). A recording is
  read the other way round where that is certain: by the declared size (a DIGIT gives 240 x 320), else by likeness to
  the other recordings' touch. Two headers or pictures a recording are opened for this, the only ones.
* The vision frame has the touch frame's name. Frames are matched by their whole number, never by a string prefix.
* Frames in no contact list of a `data<k>` that has one are background (label.contact 0).
* The split is that of test.csv, by frame; a recording's test frames are a sequence of their own. Without the CSV files:
  by hash of the recording.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from anytouch_jax.data.images import ImageError, decode
from anytouch_jax.data.readers.common import (
    Columns,
    DatasetError,
    DatasetReader,
    Frames,
    IndexOptions,
    Notes,
    RowBuilder,
    find_folder,
    hash_split,
    listing,
    numbered,
    read_json,
    read_table,
)

FRAME = r"(\d+)-[\d.e+-]+\.(?:jpe?g|png)"
TOUCH_SIZE = {240, 320}  # a DIGIT's picture, upright or lying
THUMB = 16
MARGIN = 0.3  # of correlation, by which vision must look more like touch than touch does


def read(root: Path, options: IndexOptions, notes: Notes) -> Columns:
    """Every recording of data1, data2, data3. Raises DatasetError when there is none of them."""
    parts = ("data1", "data2", "data3")
    base = find_folder(root, "tvl_dataset/hct", "hct", ".", inside=parts)
    prefix = "" if base == root else f"{base.relative_to(root).as_posix()}/"
    rows = RowBuilder("image_path", "background_path", "text", "label.contact")
    places = [f"{part}/{name}" for part in parts if (base / part).is_dir() for name in listing(base / part, notes)[0]]
    found = {place: _folders(base, place, notes) for place in places}
    pairs = {place: pair for place, pair in found.items() if pair is not None}
    turned = _swapped(
        {place: tuple(base / place / side / frames[0][1] for side, frames in pair.items() if frames)
         for place, pair in pairs.items() if all(pair.values())}
    )  # fmt: skip
    for place in sorted(turned):
        notes.skip("recording with tactile and vision swapped (read the other way round)", f"{prefix}{place}")
    for part in parts:
        if (base / part).is_dir():
            mine = {place: pair for place, pair in pairs.items() if place.startswith(f"{part}/")}
            _part(rows, notes, base / part, prefix, mine, turned, options)
    return rows.columns()


def _folders(base: Path, place: str, notes: Notes) -> dict[str, Frames] | None:
    folders = listing(base / place, notes)[0]
    if "tactile" not in folders:
        notes.skip("recording without a folder 'tactile'", place)
        return None
    sides = ("tactile", "vision") if "vision" in folders else ("tactile",)
    return {side: numbered(listing(base / place / side, notes)[1], FRAME, notes, f"{place}/{side}") for side in sides}


def _part(rows: RowBuilder, notes: Notes, folder: Path, prefix: str, pairs: dict[str, dict[str, Frames]],
          turned: set[str], options: IndexOptions) -> None:  # fmt: skip
    contact, backgrounds = _contact(folder, notes)
    tests, captions = _tables(folder, notes)
    spare = folder / "digit_background.png"
    common = f"{prefix}{folder.name}/{spare.name}" if spare.is_file() else None
    found = 0
    held = {
        place: {name for _, name in pair.get("vision" if place in turned else "tactile", [])}
        for place, pair in pairs.items()
    }
    for place, pair in pairs.items():
        touch, sight = ("vision", "tactile") if place in turned else ("tactile", "vision")
        frames, photos = pair.get(touch, []), {name for _, name in pair.get(sight, [])}
        name_of = place.split("/", 1)[1]
        keys = [f"{name_of}/{name}" for _, name in frames]
        hit = [None if contact is None else key in contact for key in keys]
        found += sum(bool(one) for one in hit)
        notes.skip("photograph missing (kept without)", place, sum(name not in photos for _, name in frames))
        parts = ["test" if key in tests else "train" for key in keys] if tests or captions else [
            hash_split("tvl", place, options)] * len(keys)  # fmt: skip
        split = ["background" if one is False else part for one, part in zip(hit, parts, strict=True)]
        named = [backgrounds.get(key) for key in keys]
        behind = [_known(one, held, turned, folder.name, prefix) for one in named]
        lost = [
            one
            for one, file in zip(named, behind, strict=True)
            if one and file is None and not (common and Path(one).name == spare.name)
        ]
        instead = f"{spare.name} instead" if common else "kept without"
        notes.skip(f"background named and not on disk ({instead})", f"{folder.name}/{next(iter(lost), '')}", len(lost))
        rows.add(
            [f"{prefix}{place}/{touch}/{name}" for _, name in frames],
            sensor="digit",
            sequence=[f"{place}/test" if part == "test" and tests else place for part in split],
            frame_index=[number for number, _ in frames],
            split=split,
            image_path=[f"{prefix}{place}/{sight}/{name}" if name in photos else None for _, name in frames],
            background_path=[one or common for one in behind],
            text=[captions.get(key) for key in keys],
            **{"label.contact": [None if one is None else int(one) for one in hit]},
        )
    notes.skip("listed contact frame that is not on disk", str(folder), len(contact) - found if contact else 0)


def _known(path: str | None, held: dict[str, set[str]], turned: set[str], part: str, prefix: str) -> str | None:
    """The background named in contact.json, where it is a frame on disk, in the folder that holds the touch; `held`:
    names of the touch frames by recording."""
    match = re.fullmatch(r"([^/]+)/(?:tactile|vision)/([^/]+)", path or "")
    if not match:
        return None
    place = f"{part}/{match[1]}"
    side = "vision" if place in turned else "tactile"
    return f"{prefix}{place}/{side}/{match[2]}" if match[2] in held.get(place, ()) else None


def _key(path: str) -> str:
    """recording/name of recording/tactile/name: swapped folders keep their key."""
    parts = path.replace("\\", "/").split("/")
    return f"{parts[-3]}/{parts[-1]}" if len(parts) > 2 else path


def _contact(folder: Path, notes: Notes) -> tuple[set[str] | None, dict[str, str]]:
    path = folder / "contact.json"
    if not path.is_file():
        notes.log(f"no {folder.name}/contact.json: which of its frames are contact is not known")
        return None, {}
    table = read_json(path)
    lists = [table.get(name, []) for name in ("tactile", "background")] if isinstance(table, dict) else [None]
    if "tactile" not in (table or ()) or not all(
        isinstance(one, list) and set(map(type, one)) <= {str} for one in lists
    ):
        raise DatasetError(
            f"{path}: expected a list 'tactile' of contact frames, and beside it a list 'background' or none"
        )
    keys = [_key(one) for one in table["tactile"]]
    return set(keys), dict(zip(keys, lists[1], strict=False))


def _tables(folder: Path, notes: Notes) -> tuple[set[str], dict[str, str]]:
    """Frames of the test table, and captions of both."""
    tests: set[str] = set()
    captions: dict[str, str] = {}
    for split in ("train", "test"):
        path = folder / f"{split}.csv"
        if not path.is_file():
            notes.log(f"no {folder.name}/{split}.csv: no captions and no test frames of it")
            continue
        for row in read_table(path):
            if "tactile" not in row:
                raise DatasetError(f"{path}: expected a column 'tactile', found {', '.join(row)}")
            key = _key(row["tactile"])
            if row.get("caption"):
                captions[key] = row["caption"]
            if split == "test":
                tests.add(key)
    return tests, captions


def _swapped(pairs: Mapping[str, tuple[Path, ...]]) -> set[str]:
    """The recordings whose picture (touch, vision) are the wrong way round; `pairs`: one of each a recording.

    By size, where only one of the two has a DIGIT's. Else by likeness: the median of all pictures said to be touch
    (of the same size class) stands for touch, and a recording is swapped when its vision correlates with it better by
    MARGIN than its touch. A recording whose pictures cannot be read is left as it is.
    """
    thumbs, turned, unclear = {}, set(), []
    for name, (touch, vision) in pairs.items():
        try:
            pictures = decode(touch), decode(vision)
        except ImageError:
            continue
        is_touch = [set(picture.shape[:2]) == TOUCH_SIZE for picture in pictures]
        if is_touch == [False, True]:
            turned.add(name)
        elif is_touch != [True, False]:
            unclear.append(name)
            thumbs[name] = tuple(_thumb(picture) for picture in pictures)
    if len(unclear) < 3:
        return turned  # a majority of two is none
    normal = np.median([thumbs[name][0] for name in unclear], axis=0).ravel()
    for name in unclear:
        likeness = [float(np.corrcoef(normal, thumb.ravel())[0, 1]) for thumb in thumbs[name]]
        if likeness[1] > likeness[0] + MARGIN:
            turned.add(name)
    return turned


def _thumb(picture: np.ndarray) -> np.ndarray:
    """Means over THUMB x THUMB cells, f32; an upright picture is laid down. A faint ramp keeps a flat one varied."""
    if picture.shape[0] > picture.shape[1]:
        picture = np.rot90(picture)
    rows = np.linspace(0, picture.shape[0] - 1, THUMB * 4).astype(int)
    cols = np.linspace(0, picture.shape[1] - 1, THUMB * 4).astype(int)
    cells = picture[rows][:, cols].astype(np.float32).reshape(THUMB, 4, THUMB, 4, 3).mean(axis=(1, 3))
    return cells + np.linspace(0, 1e-3, cells.size, dtype=np.float32).reshape(cells.shape)


READER = DatasetReader(
    name="tvl",
    read=read,
    sensor="digit",
    license="not stated",
    commercial=False,
    about="HCT: a hand-held DIGIT and a camera, with short phrases (SSVTP is a reader of its own)",
    url="https://huggingface.co/datasets/mlfu7/Touch-Vision-Language-Dataset",
    citation="Fu et al., A Touch, Vision, and Language Dataset for Multimodal Alignment, ICML 2024",
    paper=39_000,
)
