"""Touch and Go (Yang et al., NeurIPS 2022): people touch objects outdoors and indoors with a GelSight.

Layout (the authors' code and AnyTouch's loaders): `dataset/<video>/gelsight_frame/<10 digits>.jpg`, the photograph of
the same moment under the same name in `video_frame/`. `label.txt` names every contact frame. The split lists have
91,982 train and 29,879 test frames of 126 videos (35,119 and 8,085 for rough). Frames come from videos by the
dataset's extract_frame.py. No data licence is stated there (the lists are BSD-2-Clause).

* A touch is a run of consecutive listed frames. No run of the material lists is in both splits, but 100 of the 106
  test videos also have train touches. A sequence here is a run within one split.
* The lists of material and rough disagree (3,289 rough test frames are material train frames), so a manifest follows
  one of them, `task`. It has the labels of the other too, and `downstream_test` names every test list of a frame.
* -1 is no label. Soft materials are 7, 8, 9, 11, 13, as in AnyTouch's probe. 1 and 0 of rough stay unchanged.
* The background is the frame 4 before the touch: the rule behind 99 % of AnyTouch 2's background lists.
* Contact frames in no list of `task` (label.txt has about 250,000) are train frames without its label.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from anytouch_jax.data.readers.common import DatasetError, DatasetIndex, DatasetReader, read_csv

SOFT = frozenset((7, 8, 9, 11, 13))
BEFORE = 4  # frames from the background to the first frame of a touch
SOURCE = "the authors' repository fredfyyang/Touch-and-Go has them in 'Visuo-tactile contrastive learning/dataset'"


@dataclass
class _Frame:
    split: dict[str, str]
    label: dict[str, int]


Listed = dict[str, dict[int, _Frame]]  # video -> frame number -> its lists


def read(index: DatasetIndex) -> None:
    """Add the frames of every list. Raises DatasetError without `dataset` or the lists of the task."""
    base = index.find_folder("dataset")
    listed, prefix = _lists(index), index.prefix(base)
    for video in index.listing(base)[0]:
        frames = listed.pop(video, {})
        on_disk = _add_video(index, base / video, f"{prefix}{video}", frames)
        index.skip("listed frame that is not on disk", video, len(frames) - on_disk)
    for video, frames in listed.items():
        index.skip("listed frame whose video is not on disk", video, len(frames))


def _lists(index: DatasetIndex) -> Listed:
    listed: Listed = {}
    root, lists = index.root, index.options.lists
    for task, ending in (("material", ""), ("rough", "_rough")):
        for split in ("train", "test"):
            path = index.find_file([f"{split}{ending}.txt", f"{split}{ending}_bg.txt"], root, root / "dataset")
            if path is None and task == index.options.task:
                places = f"{lists} and {root}" if lists else f"{root}, or in the folder of --lists"
                raise DatasetError(f"expected the list {split}{ending}.txt in {places}; {SOURCE}")
            if path is None:
                index.notes.append(f"no {split}{ending}.txt: no labels of that list")
            else:
                _read_list(listed, path, task, split)
    all_contact = index.find_file(["label.txt"])
    if all_contact is None:
        index.notes.append(
            "no label.txt: only the frames of the split lists are taken (the paper has all contact frames)"
        )
    else:
        _read_list(listed, all_contact, None, "")
    return listed


def _read_list(listed: Listed, path: Path, task: str | None, split: str) -> None:
    for line, row in enumerate(read_csv(path), 1):
        try:
            video, name = row[0].split("/")
            number, label = int(name.partition(".")[0]), int(row[1])
        except (ValueError, IndexError):
            text = ",".join(row)
            raise DatasetError(f"{path}, line {line}: expected video/frame.jpg,label but found {text}") from None
        frame = listed.setdefault(video, {}).setdefault(number, _Frame({}, {}))
        if task is not None:
            if frame.split.setdefault(task, split) != split:
                raise DatasetError(f"{path}, line {line}: {row[0]} is in the train and in the test list of {task}")
            if label >= 0:
                frame.label[task] = label


def _add_video(index: DatasetIndex, folder: Path, prefix: str, listed: dict[int, _Frame]) -> int:
    """Add the touches of one video and return the number of its listed frames on disk."""
    task = index.options.task
    folders, files = index.listing(folder)
    if "gelsight_frame" not in folders:
        packed = "gelsight.mp4" in files
        index.skip("video that is not unpacked (run the dataset's extract_frame.py)" if packed
                   else "folder without gelsight_frame", str(folder))  # fmt: skip
        return 0
    frames = dict(index.numbered(index.listing(folder / "gelsight_frame")[1], r"(\d+)\.jpe?g", prefix))
    photos = set(index.listing(folder / "video_frame")[1]) if "video_frame" in folders else set()
    on_disk = [number for number in frames if number in listed]
    index.skip("frame in no list (no contact)", prefix, len(frames) - len(on_disk))
    index.skip("photograph missing (kept without)", prefix, sum(frames[n] not in photos for n in on_disk))
    for touch in _runs(on_disk, lambda a, b: b == a + 1):
        before = frames.get(touch[0] - BEFORE)
        for run in _runs(touch, lambda a, b: listed[a].split.get(task) == listed[b].split.get(task)):
            # A frame next to a test frame is not trained on.
            unlisted = "unused" if any(listed[n].split.get(task) == "test" for n in touch) else "train"
            split = listed[run[0]].split.get(task, unlisted)
            names, labels = [frames[n] for n in run], [listed[n].label for n in run]
            material = [label.get("material") for label in labels]
            tests = [sorted(t for t, part in listed[n].split.items() if part == "test") for n in run]
            index.add(
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
                    "label.rough": [label.get("rough") for label in labels],
                    "label.contact": 1,
                    "downstream_test": ["+".join(test) or None for test in tests],
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


READER = DatasetReader(
    read,
    url="https://touch-and-go.github.io",
    citation="Yang et al., Touch and Go: Learning from Human-Collected Vision and Touch, NeurIPS 2022",
    uses=("lists", "task"),
    paper=250_000,
)
