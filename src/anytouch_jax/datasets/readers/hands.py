"""Touches by hand, with RGB images of the same place: Touch and Go, TVL with SSVTP, and TacQuad.

Layouts are those of the authors' code, of AnyTouch's loaders and of data set cards. None states a
licence of its data.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from anytouch_jax.data.images import ImageError, decode
from anytouch_jax.datasets.readers.common import (
    DatasetError,
    DatasetIndex,
    DatasetReader,
    Frames,
    read_json,
    read_lines,
)

TASKS = {"material": "", "rough": "_rough"}  # task of Touch and Go -> ending of its lists
SOFT = frozenset((7, 8, 9, 11, 13))  # materials, as in AnyTouch's probe
BEFORE = 4  # frames from the background to the first frame of a touch
SOURCE = (
    "the authors' repository fredfyyang/Touch-and-Go has them in 'Visuo-tactile contrastive "
    "learning/dataset'"
)
# video -> frame number -> split by task, label by label.<task>
Listed = dict[str, dict[int, dict[str, Any]]]

HCT = ("data1", "data2", "data3")
FRAME = r"(\d+)-[\d.e+-]+\.(?:jpe?g|png)"
SPARE = "digit_background.png"
TOUCH_SIZE = {240, 320}  # a DIGIT's image, upright or lying
THUMB = 16
MARGIN = 0.3  # of correlations: a difference that is no chance
Sides = tuple[Frames, Frames]  # touch and vision

QUAD = {"gelsight": "gelsight_mini", "digit": "digit", "duragel": "duragel"}  # folder -> sensor
COARSE = ("indoor", "outdoor")
ON_DISK = {"shuttlecock": "yumaoqiu"}  # folder -> its name in TacQuad's list, the Chinese word


def _touch_and_go(index: DatasetIndex) -> None:
    """People touch objects with a GelSight: `dataset/<video>/gelsight_frame/<10 digits>.jpg`.

    The RGB image of the same moment has the same name in `video_frame/`. `label.txt` names every
    contact frame. Frames come from videos by the dataset's extract_frame.py. Raises DatasetError
    without the lists of the task.

    * A touch is a run of consecutive listed frames. No run of the material lists is in both splits,
      but 100 of the 106 test videos also have train touches. A sequence here is a run within one
      split.
    * The lists of material and rough disagree (3,289 rough test frames are material train frames),
      so a manifest follows one of them, `task`. It has the labels of both, and `downstream_test`
      names every test list of a frame.
    * -1 is no label. The background is the frame 4 before the touch: the rule behind 99 % of
      AnyTouch 2's lists.
    * Contact frames in no list of `task` (label.txt has about 250,000) are train frames without its
      label.
    """
    base = index.find_folder("dataset")
    if base is None:
        return
    listed = _listed_frames(index)
    for video in index.tracked(index.listing(base)[0]):
        frames = listed.pop(video, {})
        on_disk = _add_video(index, f"{base}{video}", frames)
        index.skip("listed frame that is not on disk", video, len(frames) - on_disk)
    for video, frames in listed.items():
        index.skip("listed frame whose video is not on disk", video, len(frames))


def _listed_frames(index: DatasetIndex) -> Listed:
    listed: Listed = {}
    for task, ending in TASKS.items():
        for split in ("train", "test"):
            path = index.find_file(
                [f"{split}{ending}.txt", f"{split}{ending}_bg.txt"], "", "dataset"
            )
            if path is not None:
                _read_list(listed, path, task, split)
            elif task == index.options.task:
                raise DatasetError(
                    f"expected the list {split}{ending}.txt in "
                    f"{index.options.lists or index.root}, or in the folder of --lists; {SOURCE}"
                )
            else:
                index.notes.append(f"no {split}{ending}.txt: no labels of that list")
    all_contact = index.find_file(["label.txt"])
    if all_contact is None:
        index.notes.append(
            "no label.txt: only frames of the split lists are taken (the paper has all contact "
            "frames)"
        )
    else:
        _read_list(listed, all_contact, None, "")
    return listed


def _read_list(listed: Listed, path: Path, task: str | None, split: str) -> None:
    for line, row in read_lines(path):
        try:
            video, name = row[0].split("/")
            number = int(name.partition(".")[0])
            label = int(row[1])
        except (ValueError, IndexError):
            text = ",".join(row)
            raise DatasetError(
                f"{path}, line {line}: expected video/frame.jpg,label but found {text}"
            ) from None
        frame = listed.setdefault(video, {}).setdefault(number, {})
        if task is not None:
            if frame.setdefault(task, split) != split:
                raise DatasetError(
                    f"{path}, line {line}: {row[0]} is in the train and in the test list of {task}"
                )
            if label >= 0:
                frame[f"label.{task}"] = label


def _add_video(index: DatasetIndex, folder: str, listed: dict[int, dict[str, Any]]) -> int:
    """Add the touches of one video and return the number of its listed frames on disk."""
    task = index.options.task
    folders, files = index.listing(folder)
    if "gelsight_frame" not in folders:
        packed = "gelsight.mp4" in files
        index.skip(
            "video that is not unpacked (run the dataset's extract_frame.py)"
            if packed
            else "folder without gelsight_frame",
            folder,
        )
        return 0
    frames = index.frames(f"{folder}/gelsight_frame", r"(\d+)\.jpe?g")
    photos = set(index.listing(f"{folder}/video_frame")[1]) if "video_frame" in folders else set()
    on_disk = [number for number in frames if number in listed]
    index.skip("frame in no list (no contact)", folder, len(frames) - len(on_disk))
    for touch in _runs(on_disk, lambda a, b: b == a + 1):
        before = frames.get(touch[0] - BEFORE)
        # A frame next to a test frame is not trained on.
        unlisted = "unused" if any(listed[n].get(task) == "test" for n in touch) else "train"
        for run in _runs(touch, lambda a, b: listed[a].get(task) == listed[b].get(task)):
            names = [frames[n] for n in run]
            lists = [listed[n] for n in run]
            material = [one.get("label.material") for one in lists]
            tests = ["+".join(name for name in TASKS if one.get(name) == "test") for one in lists]
            index.add(
                [f"{folder}/gelsight_frame/{name}" for name in names],
                sensor="gelsight",
                frame_index=run,
                sequence=f"{Path(folder).name}/{run[0]}",
                split=lists[0].get(task, unlisted),
                image_path=index.rgb_images(f"{folder}/video_frame", names, photos),
                background_path=before and f"{folder}/gelsight_frame/{before}",
                downstream_test=[test or None for test in tests],
                **{
                    "label.material": material,
                    "label.rough": [one.get("label.rough") for one in lists],
                    "label.hardness": [
                        None if m is None else "soft" if m in SOFT else "hard" for m in material
                    ],
                    "label.contact": 1,
                },
            )
    return len(on_disk)


def _runs(numbers: list[int], together: Callable[[int, int], bool]) -> list[list[int]]:
    runs: list[list[int]] = []
    for number in numbers:
        if runs and together(runs[-1][-1], number):
            runs[-1].append(number)
        else:
            runs.append([number])
    return runs


def _ssvtp(index: DatasetIndex) -> None:
    """A robot presses a DIGIT on textiles and RGB images the place.

    `caption_id` is of TacQuad's download.
    """
    base = index.find_folder("tvl_dataset/ssvtp", "ssvtp", "ssvtp_data", "", inside=("images_tac",))
    if base is None:
        return
    frames = index.frames(f"{base}images_tac", r"image_(\d+)_tac\.(?:jpe?g|png)")
    photos = index.frames(f"{base}images_rgb", r"image_(\d+)_rgb\.(?:jpe?g|png)")
    names = [photos.get(number, "") for number in frames]
    index.skip("RGB image without touch", "images_rgb", len(photos.keys() - frames.keys()))
    tests, captions = index.read_captions(base, lambda path: Path(path).name)
    index.add(
        [f"{base}images_tac/{name}" for name in frames.values()],
        sensor="digit",
        frame_index=0,
        sequence=[f"image_{number}" for number in frames],
        split=[
            ("test" if name in tests else "train") if tests else index.split_of(str(number))
            for number, name in frames.items()
        ],
        image_path=index.rgb_images(f"{base}images_rgb", names, set(photos.values())),
        text=[captions.get(name) for name in frames.values()],
        caption_id=[f"ssvtp_{number}" for number in frames],
    )


def _tvl(index: DatasetIndex) -> None:
    """A hand-held DIGIT and a camera:
    `hct/data{1,2,3}/<recording>/{tactile,vision}/<id>-<time>.jpg`.

    In the authors' loader `contact.json` of each `data<k>` holds equally long lists `tactile`,
    `vision`, `background` of paths below `data<k>`, and a missing background means
    `data<k>/digit_background.png`. Frames in no contact list of a `data<k>` that has one are
    background (label.contact 0). The vision frame has the touch frame's name. Frames are matched by
    their whole number, never by a string prefix. A recording's test frames are a separate sequence.
    `train.csv` and `test.csv` have the columns tactile and caption (T3). The split is that of
    test.csv, else by hash.

    Some recordings have the two folders swapped (reported to the authors, who point to a corrected
    copy). They are read the other way round, if `_swapped` is certain. It opens two images of
    each recording, and no others.
    """
    base = index.find_folder("tvl_dataset/hct", "hct", "", inside=HCT)
    parts = [part for part in HCT if base is not None and (index.root / base / part).is_dir()]
    recordings: dict[str, Sides] = {}
    listed = [f"{part}/{name}" for part in parts for name in index.listing(f"{base}{part}")[0]]
    for place in index.tracked(listed):
        if "tactile" in index.listing(f"{base}{place}")[0]:
            touch, vision = (
                index.frames(f"{base}{place}/{side}", FRAME) for side in ("tactile", "vision")
            )
            recordings[place] = touch, vision
        else:
            index.skip("recording without a folder 'tactile'", place)
    first = {
        place: [
            index.root / f"{base}{place}/{side}" / next(iter(frames.values()))
            for side, frames in zip(("tactile", "vision"), pair, strict=True)
        ]
        for place, pair in recordings.items()
        if all(pair)
    }
    swapped, unclear = _swapped(first)
    for reason, places in (
        ("are swapped (read the other way round)", swapped),
        ("may be swapped (read by their names)", unclear),
    ):
        for place in sorted(places):
            index.skip(f"recording whose tactile and vision {reason}", f"{base}{place}")
    for part in parts:
        mine = {place: pair for place, pair in recordings.items() if place.startswith(f"{part}/")}
        _add_part(index, base or "", part, mine, swapped)


def _add_part(
    index: DatasetIndex, base: str, part: str, recordings: dict[str, Sides], swapped: set[str]
) -> None:
    """Add the recordings of one `data<k>` with its contact list, its captions and its backgrounds.

    `recordings` are the frames of the folders tactile and vision by place. Those in `swapped` have
    touch in the folder vision.
    """
    contact, backgrounds = _hct_contact(index, f"{base}{part}/")
    tests, captions = index.read_captions(f"{base}{part}/", _key)
    has_lists = bool(tests or captions)
    spare = f"{base}{part}/{SPARE}"
    default = spare if (index.root / spare).is_file() else None
    folders = {
        place: [f"{base}{place}/{side}" for side in ("tactile", "vision")] for place in recordings
    }
    # A background may be any touch frame of this part.
    on_disk = {
        f"{place.partition('/')[2]}/{name}": f"{folders[place][place in swapped]}/{name}"
        for place, pair in recordings.items()
        for name in pair[place in swapped].values()
    }
    contact_rows = 0
    for place, pair in recordings.items():
        touch, vision = (1, 0) if place in swapped else (0, 1)
        names = list(pair[touch].values())
        keys = [f"{place.partition('/')[2]}/{name}" for name in names]
        is_contact = [None if contact is None else key in contact for key in keys]
        contact_rows += sum(map(bool, is_contact))
        own_split = None if has_lists else index.split_of(place)
        splits = []
        for key, touched in zip(keys, is_contact, strict=True):
            split = own_split or ("test" if key in tests else "train")
            splits.append("background" if touched is False else split)
        named = [backgrounds.get(key, "") for key in keys]
        _report_lost(index, part, named, on_disk, has_spare=default is not None)
        index.add(
            [f"{folders[place][touch]}/{name}" for name in names],
            sensor="digit",
            frame_index=list(pair[touch]),
            sequence=[f"{place}/test" if split == "test" and tests else place for split in splits],
            split=splits,
            image_path=index.rgb_images(folders[place][vision], names, set(pair[vision].values())),
            background_path=[on_disk.get(_key(path), default) for path in named],
            text=[captions.get(key) for key in keys],
            **{"label.contact": [None if one is None else int(one) for one in is_contact]},
        )
    missing = len(contact) - contact_rows if contact else 0
    index.skip("listed contact frame that is not on disk", f"{base}{part}", missing)


def _report_lost(
    index: DatasetIndex, part: str, named: list[str], on_disk: dict[str, str], *, has_spare: bool
) -> None:
    """Report backgrounds that a contact list names and that are not on disk.

    The image for the whole part (SPARE) takes their place where it is there, and is named itself
    by frames without a background.
    """
    lost = []
    for path in named:
        is_spare = has_spare and SPARE in path
        if path and _key(path) not in on_disk and not is_spare:
            lost.append(path)
    instead = f"{SPARE} instead" if has_spare else "kept without"
    first = lost[0] if lost else ""
    index.skip(f"background named and not on disk ({instead})", f"{part}/{first}", len(lost))


def _key(path: str) -> str:
    """Return recording/name of recording/tactile/name, so that swapped folders have the same
    key.
    """
    parts = path.replace("\\", "/").split("/")
    if len(parts) > 2:
        return f"{parts[-3]}/{parts[-1]}"
    return path


def _hct_contact(index: DatasetIndex, folder: str) -> tuple[set[str] | None, dict[str, str]]:
    """Return the keys of contact frames (None: unknown), and their backgrounds."""
    path = index.root / folder / "contact.json"
    if not path.is_file():
        index.notes.append(f"no {folder}contact.json: which of its frames are contact is not known")
        return None, {}
    table = read_json(path)
    touch = table.get("tactile")
    backgrounds = table.get("background", [])
    for paths in (touch, backgrounds):
        if not isinstance(paths, list) or not all(isinstance(one, str) for one in paths):
            raise DatasetError(
                f"{path}: expected a list 'tactile' of contact frames, and a list 'background' or "
                "none"
            )
    keys = [_key(name) for name in touch or ()]
    return set(keys), dict(zip(keys, backgrounds, strict=False))


def _swapped(first: Mapping[str, Sequence[Path]]) -> tuple[set[str], set[str]]:
    """Return the recordings whose images (tactile, vision) are swapped, and those where that
    cannot be known.

    They are known by size, if only one of the two has a DIGIT's. Else touch is the side that is
    like those of most other recordings. Where scenes are alike too, the names of two thirds of the
    recordings must agree.
    """
    swapped = set()
    thumbs = {}
    for place, paths in first.items():
        try:
            images = [decode(path) for path in paths]
        except ImageError:
            continue
        is_touch = [set(image.shape[:2]) == TOUCH_SIZE for image in images]
        if is_touch == [False, True]:
            swapped.add(place)
        elif is_touch != [True, False]:
            thumbs[place] = [_thumb(image).ravel() for image in images]
    places = np.array(list(thumbs))
    count = len(thumbs)
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
    turned = (
        to_first[0, :, 1] + to_first[1, :, 0] - to_first[0, :, 0] - to_first[1, :, 1] > 2 * MARGIN
    )
    fewer = turned if 2 * turned.sum() <= rest.size else ~turned
    if 3 * fewer.sum() > rest.size:
        return swapped, set(places[rest].tolist())
    return swapped | set(places[rest[fewer]].tolist()), set()


def _thumb(image: np.ndarray) -> np.ndarray:
    """Return means over THUMB x THUMB cells of a lying image, f32, with a faint ramp so that no
    image is flat.
    """
    if image.shape[0] > image.shape[1]:
        image = np.rot90(image)
    cells = cv2.resize(image, (THUMB, THUMB), interpolation=cv2.INTER_AREA).astype(np.float32)
    return cells + np.linspace(0, 1e-3, cells.size, dtype=np.float32).reshape(cells.shape)


def _tacquad(index: DatasetIndex) -> None:
    """The same place of an object by four sensors:
    `data_{indoor,outdoor}/<item>/{gelsight,digit,duragel}/<n>.png`.

    `gelsight` is the GelSight Mini. RGB images are `img_{gelsight,digit,duragel}/<n>.png`.
    `contact_<subset>.csv` has no header: item, then first and last contact frame of gelsight,
    digit, duragel. Assumed: the fine subset has the same layout (`data_fine`), and further columns
    are Tac3D's, whose force fields are counted and left out. Raises DatasetError for a subset
    without its list.

    * Contact frames get the item's split, the others `background` (label.contact 0). The first
      frame of a recording is its background if contact begins later. The RGB image is that of the
      same fraction of the recording.
    * `touch` is the item, equal for all sensors, and `caption_id` the name of its caption in the
      authors' download.
    * The fine subset is `unused`: the paper reserves it for cross-sensor generation.
    """
    subsets = [
        name.removeprefix("data_") for name in index.listing("")[0] if name.startswith("data_")
    ]
    index.notes += [
        f"no data_{subset}: that subset is left out" for subset in COARSE if subset not in subsets
    ]
    for subset in subsets:
        contact = _contact_spans(index, subset)
        for item in index.tracked(index.listing(f"data_{subset}")[0]):
            place = f"data_{subset}/{item}"
            listed = item if item in contact else ON_DISK.get(item, item)
            if listed not in contact:
                index.skip(f"item that is not in contact_{subset}.csv", place)
                continue
            if listed != item:
                index.notes.append(
                    f"{place} is {listed!r} in contact_{subset}.csv: its lines are used"
                )
            number, spans = contact.pop(listed)
            split = index.split_of(item) if subset in COARSE else "unused"
            cells = {
                "object": item,
                "touch": f"{subset}/{item}",
                "subset": subset,
                "split": split,
                "caption_id": f"tacquad_{subset}_{number}",
            }
            _add_item(index, place, spans, cells)
        for item in contact:
            index.skip(f"item of contact_{subset}.csv that is not on disk", f"data_{subset}/{item}")


def _contact_spans(
    index: DatasetIndex, subset: str
) -> dict[str, tuple[int, list[tuple[int, int]]]]:
    """Return item -> its number in the list (from 0) and (first, last contact frame) of each
    sensor.
    """
    path = index.find_file([f"contact_{subset}.csv"])
    if path is None:
        place = index.options.lists or index.root
        raise DatasetError(
            f"expected the list contact_{subset}.csv in {place}, next to data_{subset}"
        )
    spans: dict[str, tuple[int, list[tuple[int, int]]]] = {}
    for number, (line, row) in enumerate(read_lines(path)):
        try:
            ends = [int(cell) for cell in row[1 : 2 * len(QUAD) + 1]]
            if len(ends) != 2 * len(QUAD) or row[0] in spans:
                raise ValueError
        except ValueError:
            raise DatasetError(
                f"{path}, line {line}: expected a new item and six frame numbers, "
                f"found {','.join(row)}"
            ) from None
        spans[row[0]] = number, list(zip(ends[::2], ends[1::2], strict=True))
    return spans


def _add_item(
    index: DatasetIndex, place: str, spans: list[tuple[int, int]], cells: dict[str, Any]
) -> None:
    folders = index.listing(place)[0]
    for folder in folders:
        if folder.removeprefix("img_") not in QUAD:
            index.skip(f"folder {folder!r} (no sensor with images)", f"{place}/{folder}")
    for (folder, sensor), (first, last) in zip(QUAD.items(), spans, strict=True):
        path = f"{place}/{folder}"
        if folder not in folders:
            index.skip("item without a sensor", path)
            continue
        frames = index.frames(path)
        contact = [first <= number <= last for number in frames]
        index.skip(
            "contact frame that is not on disk", path, max(last - first + 1, 0) - sum(contact)
        )
        start = min(frames, default=0)
        free = "unused" if cells["split"] == "unused" else "background"
        # of the same fraction of the recording; numbers may have gaps
        photos = index.frames(f"{place}/img_{folder}")
        most = max(photos, default=-1) + 1
        length = max(frames, default=0) + 1
        names = [photos.get(number * most // length, "") for number in frames]
        index.add(
            [f"{path}/{name}" for name in frames.values()],
            sensor=sensor,
            sequence=path,
            frame_index=list(frames),
            image_path=index.rgb_images(f"{place}/img_{folder}", names, set(photos.values())),
            background_path=f"{path}/{frames[start]}"
            if frames and start < first and not contact[0]
            else None,
            **cells
            | {
                "split": [cells["split"] if touched else free for touched in contact],
                "label.contact": [int(touched) for touched in contact],
            },
        )


READERS = {
    "touch_and_go": DatasetReader(
        _touch_and_go,
        "dataset/<video>/gelsight_frame/0000000000.jpg",
        "Yang et al., Touch and Go: Learning from Human-Collected Vision and Touch, NeurIPS 2022",
        url="https://touch-and-go.github.io",
        uses=("lists", "task"),
        paper=250_000,
    ),
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
        "Kerr et al., Self-Supervised Visuo-Tactile Pretraining to Locate and Follow Garment "
        "Features, RSS 2023",
        url="https://sites.google.com/berkeley.edu/ssvtp",
        paper=4_500,
    ),
    "tacquad": DatasetReader(
        _tacquad,
        "data_indoor/<item>/gelsight/0.png",
        "Feng et al., AnyTouch: Learning Unified Static-Dynamic Representation across Multiple "
        "Visuo-tactile Sensors, ICLR 2025",
        url="https://huggingface.co/datasets/xxuan01/TacQuad",
        uses=("val", "test", "lists"),
        paper=55_082,
        paper_note="coarse; 17,524 fine; both with Tac3D",
    ),
}
