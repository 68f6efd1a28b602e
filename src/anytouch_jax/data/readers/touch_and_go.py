"""Touch and Go (Yang et al., NeurIPS 2022): people touch objects outdoors and indoors with a GelSight.

Seen: the split lists, whole (91,982 train and 29,879 test frames of 126 videos; 35,119 and 8,085 for rough); the
layout from the authors' code and AnyTouch's loaders: `dataset/<video>/gelsight_frame/<10 digits>.jpg`, the photograph
of the same moment under the same name in `video_frame/`; `label.txt` names every contact frame. Frames come from
videos by the dataset's own extract_frame.py. No data licence is stated there (the lists are BSD-2-Clause).

* One touch is a run of consecutive listed frames; no run of the material lists is in both splits, but 100 of the 106
  test videos also have train touches. A sequence here is a run within one split.
* The lists of material and rough disagree (3,289 rough test frames are material train frames), so a manifest follows
  one of them, `task`; the other's labels are kept and `downstream_test` names every test list a frame is in.
* -1 is no label. Soft materials are 7, 8, 9, 11, 13, as in AnyTouch's probe. 1 and 0 of rough are kept as they are.
* The background is the frame 4 before the touch: the rule behind 99 % of AnyTouch 2's background lists.
* Contact frames in no list of `task` (label.txt has about 250,000) are train frames without its label.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from anytouch_jax.data.readers.common import (
    Columns,
    DatasetError,
    DatasetReader,
    IndexOptions,
    Notes,
    RowBuilder,
    find_file,
    find_folder,
    listing,
    numbered,
    read_csv,
)

SOFT = frozenset((7, 8, 9, 11, 13))
BEFORE = 4  # frames from the background to the first frame of a touch
SOURCE = "the authors' repository fredfyyang/Touch-and-Go has them in 'Visuo-tactile contrastive learning/dataset'"


@dataclass
class _Frame:
    split: dict[str, str]
    label: dict[str, int]


def read(root: Path, options: IndexOptions, notes: Notes) -> Columns:
    """The frames of every list, as columns. Raises DatasetError without `dataset` or the lists of the task."""
    base = find_folder(root, "dataset")
    known = _lists(root, options, notes)
    rows = RowBuilder("image_path", "background_path", "label.material", "label.hardness", "label.rough",
                "label.contact", "downstream_test")  # fmt: skip
    prefix = base.relative_to(root).as_posix()
    for video in listing(base, notes)[0]:
        frames = known.pop(video, {})
        found = _video(rows, notes, base / video, f"{prefix}/{video}", frames, options.task)
        notes.skip("listed frame that is not on disk", video, len(frames) - found)
    for video, frames in known.items():
        notes.skip("listed frame whose video is not on disk", video, len(frames))
    return rows.columns()


def _lists(root: Path, options: IndexOptions, notes: Notes) -> dict[str, dict[int, _Frame]]:
    known: dict[str, dict[int, _Frame]] = {}
    for task, ending in (("material", ""), ("rough", "_rough")):
        for split in ("train", "test"):
            path = find_file([f"{split}{ending}.txt", f"{split}{ending}_bg.txt"], options.lists, root, root / "dataset")
            if path is None and task == options.task:
                places = f"{options.lists} and {root}" if options.lists else f"{root} (or say where with --lists)"
                raise DatasetError(f"expected the list {split}{ending}.txt in {places}; {SOURCE}")
            if path is None:
                notes.log(f"no {split}{ending}.txt: no labels of that list")
            else:
                _read_list(known, path, task, split)
    every = find_file(["label.txt"], options.lists, root)
    if every is None:
        notes.log("no label.txt: only the frames of the split lists are taken (the paper has all contact frames)")
    else:
        _read_list(known, every, None, "")
    return known


def _read_list(known: dict[str, dict[int, _Frame]], path: Path, task: str | None, split: str) -> None:
    for line, row in enumerate(read_csv(path), 1):
        try:
            video, name = row[0].split("/")
            number, label = int(name.partition(".")[0]), int(row[1])
        except (ValueError, IndexError):
            found = ",".join(row)
            raise DatasetError(f"{path}, line {line}: expected video/frame.jpg,label but found {found}") from None
        frame = known.setdefault(video, {}).setdefault(number, _Frame({}, {}))
        if task is not None:
            if frame.split.setdefault(task, split) != split:
                raise DatasetError(f"{path}, line {line}: {row[0]} is in the train and in the test list of {task}")
            if label >= 0:
                frame.label[task] = label


def _video(rows: RowBuilder, notes: Notes, folder: Path, prefix: str, known: dict[int, _Frame], task: str) -> int:
    """Add the touches of one video; the count of its listed frames that are there."""
    folders, files = listing(folder, notes)
    if "gelsight_frame" not in folders:
        packed = "gelsight.mp4" in files
        notes.skip("video that is not unpacked (run the dataset's extract_frame.py)" if packed
                   else "folder without gelsight_frame", str(folder))  # fmt: skip
        return 0
    frames = dict(numbered(listing(folder / "gelsight_frame", notes)[1], r"(\d+)\.jpe?g", notes, prefix))
    photos = set(listing(folder / "video_frame", notes)[1]) if "video_frame" in folders else set()
    there = [number for number in frames if number in known]
    notes.skip("frame in no list (no contact)", prefix, len(frames) - len(there))
    notes.skip("photograph missing (kept without)", prefix, sum(frames[n] not in photos for n in there))
    for touch in _runs(there, lambda a, b: b == a + 1):
        before = frames.get(touch[0] - BEFORE)
        for run in _runs(touch, lambda a, b: known[a].split.get(task) == known[b].split.get(task)):
            unlisted = "unused" if any(known[n].split.get(task) == "test" for n in touch) else "train"
            split = known[run[0]].split.get(task, unlisted)  # no frame is trained on beside one of a test
            _touch(rows, prefix, frames, photos, [known[n] for n in run], run, before, split)
    return len(there)


def _touch(rows: RowBuilder, prefix: str, frames: dict[int, str], photos: set[str], known: list[_Frame], run: list[int],
           before: str | None, split: str) -> None:  # fmt: skip
    names = [frames[number] for number in run]
    material = [frame.label.get("material") for frame in known]
    tests = ["+".join(sorted(t for t, split in frame.split.items() if split == "test")) for frame in known]
    rows.add(
        [f"{prefix}/gelsight_frame/{name}" for name in names],
        sensor="gelsight",
        sequence=f"{Path(prefix).name}/{run[0]}",
        frame_index=run,
        split=split,
        image_path=[f"{prefix}/video_frame/{name}" if name in photos else None for name in names],
        background_path=before and f"{prefix}/gelsight_frame/{before}",
        **{
            "label.material": material,
            "label.hardness": [None if m is None else "soft" if m in SOFT else "hard" for m in material],
            "label.rough": [frame.label.get("rough") for frame in known],
            "label.contact": 1,
            "downstream_test": [test or None for test in tests],
        },
    )


def _runs(numbers: list[int], together: Callable[[int, int], bool]) -> list[list[int]]:
    runs: list[list[int]] = []
    for number in numbers:
        if runs and together(runs[-1][-1], number):
            runs[-1].append(number)
        else:
            runs.append([number])
    return runs


READER = DatasetReader(
    name="touch_and_go",
    read=read,
    sensor="gelsight",
    license="not stated",
    commercial=False,
    about="touches of objects indoors and outdoors, with photographs; labels material, hardness, rough",
    url="https://touch-and-go.github.io",
    citation="Yang et al., Touch and Go: Learning from Human-Collected Vision and Touch, NeurIPS 2022",
    uses=("lists", "task"),
    paper=250_000,
)
