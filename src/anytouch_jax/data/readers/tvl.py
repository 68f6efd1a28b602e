"""TVL (Fu et al., ICML 2024): its human-collected part HCT, and SSVTP (Kerr et al., RSS 2023), which it includes.

The layouts are those of the dataset's card. `train.csv` and `test.csv` have the columns tactile and caption (T3). The
split is that of test.csv, else by hash. Code is Apache-2.0. No licence of the data was found.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from anytouch_jax.data.images import ImageError, decode
from anytouch_jax.data.readers.common import DatasetError, DatasetIndex, DatasetReader, Frames, read_json

PARTS = ("data1", "data2", "data3")
FRAME = r"(\d+)-[\d.e+-]+\.(?:jpe?g|png)"
SPARE = "digit_background.png"
TOUCH_SIZE = {240, 320}  # a DIGIT's picture, upright or lying
THUMB = 16
MARGIN = 0.3  # of correlations: a difference that is no chance
Sides = tuple[Frames, Frames]  # touch and vision


def _ssvtp(index: DatasetIndex) -> None:
    """A robot presses a DIGIT on textiles and photographs the same place; every picture is a sequence.

    `caption_id` is the name of the long caption in TacQuad's download.
    """
    base = index.find_folder("tvl_dataset/ssvtp", "ssvtp", "ssvtp_data", "", inside=("images_tac",))
    if base is None:
        return
    frames = index.frames(f"{base}images_tac", r"image_(\d+)_tac\.(?:jpe?g|png)")
    photos = index.frames(f"{base}images_rgb", r"image_(\d+)_rgb\.(?:jpe?g|png)")
    names = [photos.get(number, "") for number in frames]
    index.skip("photograph without touch", "images_rgb", len(photos.keys() - frames.keys()))
    tests, captions = index.read_captions(base, lambda path: Path(path).name)
    index.add(
        [f"{base}images_tac/{name}" for name in frames.values()],
        sensor="digit",
        sequence=[f"image_{number}" for number in frames],
        frame_index=0,
        split=[("test" if name in tests else "train") if tests else index.split_of(str(number))
               for number, name in frames.items()],
        image_path=index.photographs(f"{base}images_rgb", names, set(photos.values())),
        text=[captions.get(name) for name in frames.values()],
        caption_id=[f"ssvtp_{number}" for number in frames],
    )  # fmt: skip


def _tvl(index: DatasetIndex) -> None:
    """A hand-held DIGIT and a camera: `hct/data{1,2,3}/<recording>/{tactile,vision}/<id>-<time>.jpg`.

    In the authors' loader `contact.json` of each `data<k>` holds equally long lists `tactile`, `vision`, `background`
    of paths below `data<k>`, and a missing background means `data<k>/digit_background.png`. Frames in no contact list
    of a `data<k>` that has one are background (label.contact 0). The vision frame has the touch frame's name. Frames
    are matched by their whole number, never by a string prefix. A recording's test frames are a separate sequence.

    Some recordings have the two folders swapped (reported to the authors, who point to a corrected copy). They are
    read the other way round, if `_swapped` is certain. It opens two pictures of each recording, and no others.
    """
    base = index.find_folder("tvl_dataset/hct", "hct", "", inside=PARTS)
    parts = [part for part in PARTS if base is not None and (index.root / base / part).is_dir()]
    recordings: dict[str, Sides] = {}
    listed = [f"{part}/{name}" for part in parts for name in index.listing(f"{base}{part}")[0]]
    for place in index.tracked(listed):
        if "tactile" in index.listing(f"{base}{place}")[0]:
            touch, vision = (index.frames(f"{base}{place}/{side}", FRAME) for side in ("tactile", "vision"))
            recordings[place] = touch, vision
        else:
            index.skip("recording without a folder 'tactile'", place)
    first = {
        place: [index.root / f"{base}{place}/{side}" / next(iter(frames.values()))
                for side, frames in zip(("tactile", "vision"), pair, strict=True)]
        for place, pair in recordings.items() if all(pair)
    }  # fmt: skip
    swapped, unclear = _swapped(first)
    for reason, places in (("are swapped (read the other way round)", swapped),
                           ("may be swapped (read by their names)", unclear)):  # fmt: skip
        for place in sorted(places):
            index.skip(f"recording whose tactile and vision {reason}", f"{base}{place}")
    for part in parts:
        mine = {place: pair for place, pair in recordings.items() if place.startswith(f"{part}/")}
        _add_part(index, base or "", part, mine, swapped)


def _add_part(index: DatasetIndex, base: str, part: str, recordings: dict[str, Sides], swapped: set[str]) -> None:
    contact, backgrounds = _contact(index, f"{base}{part}/")
    tests, captions = index.read_captions(f"{base}{part}/", _key)
    spare = f"{base}{part}/{SPARE}"
    default = spare if (index.root / spare).is_file() else None
    instead = f"{SPARE} instead" if default else "kept without"
    folders = {place: [f"{base}{place}/{side}" for side in ("tactile", "vision")] for place in recordings}
    on_disk = {  # a background may be any touch frame of this part
        f"{place.partition('/')[2]}/{name}": f"{folders[place][place in swapped]}/{name}"
        for place, pair in recordings.items()
        for name in pair[place in swapped].values()
    }
    contact_rows = 0
    for place, pair in recordings.items():
        touch, vision = (0, 1) if place not in swapped else (1, 0)
        names = list(pair[touch].values())
        keys = [f"{place.partition('/')[2]}/{name}" for name in names]
        is_contact = [None if contact is None else key in contact for key in keys]
        contact_rows += sum(map(bool, is_contact))
        splits = ["test" if key in tests else "train" for key in keys]
        if not (tests or captions):
            splits = [index.split_of(place)] * len(keys)
        splits = ["background" if c is False else split for c, split in zip(is_contact, splits, strict=True)]
        named = [backgrounds.get(key, "") for key in keys]
        lost = [path for path in named if path and _key(path) not in on_disk and not (default and SPARE in path)]
        index.skip(f"background named and not on disk ({instead})", f"{part}/{''.join(lost[:1])}", len(lost))
        index.add(
            [f"{folders[place][touch]}/{name}" for name in names],
            sensor="digit",
            sequence=[f"{place}/test" if split == "test" and tests else place for split in splits],
            frame_index=list(pair[touch]),
            split=splits,
            image_path=index.photographs(folders[place][vision], names, set(pair[vision].values())),
            background_path=[on_disk.get(_key(path), default) for path in named],
            text=[captions.get(key) for key in keys],
            **{"label.contact": [None if c is None else int(c) for c in is_contact]},
        )
    missing = len(contact) - contact_rows if contact else 0
    index.skip("listed contact frame that is not on disk", f"{base}{part}", missing)


def _key(path: str) -> str:
    """Return recording/name of recording/tactile/name, so that swapped folders have the same key."""
    parts = path.replace("\\", "/").split("/")
    return f"{parts[-3]}/{parts[-1]}" if len(parts) > 2 else path


def _contact(index: DatasetIndex, folder: str) -> tuple[set[str] | None, dict[str, str]]:
    """Return the keys of contact frames (None: unknown), and their backgrounds."""
    path = index.root / folder / "contact.json"
    if not path.is_file():
        index.notes.append(f"no {folder}contact.json: which of its frames are contact is not known")
        return None, {}
    table = read_json(path)
    touch, backgrounds = table.get("tactile"), table.get("background", [])
    for paths in (touch, backgrounds):
        if not isinstance(paths, list) or not all(isinstance(one, str) for one in paths):
            raise DatasetError(f"{path}: expected a list 'tactile' of contact frames, and a list 'background' or none")
    keys = [_key(name) for name in touch or ()]
    return set(keys), dict(zip(keys, backgrounds, strict=False))


def _swapped(first: Mapping[str, Sequence[Path]]) -> tuple[set[str], set[str]]:
    """Return the recordings whose pictures (tactile, vision) are swapped, and those where that cannot be known.

    They are known by size, if only one of the two has a DIGIT's. Otherwise touch is the side with a picture like it in
    most other recordings, whatever their folders are called: gels are alike, and scenes are not. Where the scenes are
    alike too, the names of two thirds of the recordings must agree. A picture that cannot be read changes nothing.
    """
    swapped, thumbs = set(), {}
    for place, paths in first.items():
        try:
            pictures = [decode(path) for path in paths]
        except ImageError:
            continue
        is_touch = [set(picture.shape[:2]) == TOUCH_SIZE for picture in pictures]
        if is_touch == [False, True]:
            swapped.add(place)
        elif is_touch != [True, False]:
            thumbs[place] = [_thumb(picture).ravel() for picture in pictures]
    places, count = np.array(list(thumbs)), len(thumbs)
    if count < 3:
        return swapped, set()  # two recordings have no majority
    alike = np.corrcoef(np.concatenate(list(thumbs.values()))).reshape(count, 2, count, 2)
    alike[np.arange(count), :, np.arange(count)] = np.nan
    support = np.nanmedian(alike.max(3), axis=2)
    excess = support[:, 1] - support[:, 0]
    swapped |= set(places[excess > MARGIN].tolist())
    rest = np.flatnonzero(np.abs(excess) <= MARGIN)
    if not rest.size:
        return swapped, set()
    to_first = alike[rest[0]][:, rest]
    turned = to_first[0, :, 1] + to_first[1, :, 0] - to_first[0, :, 0] - to_first[1, :, 1] > 2 * MARGIN
    fewer = turned if 2 * turned.sum() <= rest.size else ~turned
    if 3 * fewer.sum() > rest.size:
        return swapped, set(places[rest].tolist())
    return swapped | set(places[rest[fewer]].tolist()), set()


def _thumb(picture: np.ndarray) -> np.ndarray:
    """Return means over THUMB x THUMB cells of a lying picture, f32, with a faint ramp so that no picture is flat."""
    if picture.shape[0] > picture.shape[1]:
        picture = np.rot90(picture)
    cells = cv2.resize(picture, (THUMB, THUMB), interpolation=cv2.INTER_AREA).astype(np.float32)
    return cells + np.linspace(0, 1e-3, cells.size, dtype=np.float32).reshape(cells.shape)


READERS = {
    "tvl": DatasetReader(
        _tvl,
        "hct/data1/<recording>/tactile/0-0.1.jpg",
        "Fu et al., A Touch, Vision, and Language Dataset for Multimodal Alignment, ICML 2024",
        url="https://huggingface.co/datasets/mlfu7/Touch-Vision-Language-Dataset",
        paper=39_000,
    ),
    "ssvtp": DatasetReader(
        _ssvtp,
        "ssvtp/images_tac/image_0_tac.jpg",
        "Kerr et al., Self-Supervised Visuo-Tactile Pretraining to Locate and Follow Garment Features, RSS 2023",
        url="https://sites.google.com/berkeley.edu/ssvtp",
        paper=4_500,
    ),
}
