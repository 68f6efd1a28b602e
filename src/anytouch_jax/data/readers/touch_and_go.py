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
from pathlib import Path
from typing import Any

from anytouch_jax.data.readers.common import DatasetError, DatasetIndex, DatasetReader, read_lines

TASKS = {"material": "", "rough": "_rough"}  # task -> ending of its lists
SOFT = frozenset((7, 8, 9, 11, 13))
BEFORE = 4  # frames from the background to the first frame of a touch
SOURCE = "the authors' repository fredfyyang/Touch-and-Go has them in 'Visuo-tactile contrastive learning/dataset'"
Listed = dict[str, dict[int, dict[str, Any]]]  # video -> frame number -> split by task, label by label.<task>


def read(index: DatasetIndex) -> None:
    """Add the frames of every list. Raises DatasetError without the lists of the task."""
    base = index.find_folder("dataset")
    if base is None:
        return
    listed = _lists(index)
    for video in index.tracked(index.listing(base)[0]):
        frames = listed.pop(video, {})
        on_disk = _add_video(index, f"{base}{video}", frames)
        index.skip("listed frame that is not on disk", video, len(frames) - on_disk)
    for video, frames in listed.items():
        index.skip("listed frame whose video is not on disk", video, len(frames))


def _lists(index: DatasetIndex) -> Listed:
    listed: Listed = {}
    for task, ending in TASKS.items():
        for split in ("train", "test"):
            path = index.find_file([f"{split}{ending}.txt", f"{split}{ending}_bg.txt"], "", "dataset")
            if path is not None:
                _read_list(listed, path, task, split)
            elif task == index.options.task:
                raise DatasetError(f"expected the list {split}{ending}.txt in {index.options.lists or index.root}, or "
                                   f"in the folder of --lists; {SOURCE}")  # fmt: skip
            else:
                index.notes.append(f"no {split}{ending}.txt: no labels of that list")
    all_contact = index.find_file(["label.txt"])
    if all_contact is None:
        index.notes.append("no label.txt: only frames of the split lists are taken (the paper has all contact frames)")
    else:
        _read_list(listed, all_contact, None, "")
    return listed


def _read_list(listed: Listed, path: Path, task: str | None, split: str) -> None:
    for line, row in read_lines(path):
        try:
            video, name = row[0].split("/")
            number, label = int(name.partition(".")[0]), int(row[1])
        except (ValueError, IndexError):
            text = ",".join(row)
            raise DatasetError(f"{path}, line {line}: expected video/frame.jpg,label but found {text}") from None
        frame = listed.setdefault(video, {}).setdefault(number, {})
        if task is not None:
            if frame.setdefault(task, split) != split:
                raise DatasetError(f"{path}, line {line}: {row[0]} is in the train and in the test list of {task}")
            if label >= 0:
                frame[f"label.{task}"] = label


def _add_video(index: DatasetIndex, folder: str, listed: dict[int, dict[str, Any]]) -> int:
    """Add the touches of one video and return the number of its listed frames on disk."""
    task = index.options.task
    folders, files = index.listing(folder)
    if "gelsight_frame" not in folders:
        packed = "gelsight.mp4" in files
        index.skip("video that is not unpacked (run the dataset's extract_frame.py)" if packed
                   else "folder without gelsight_frame", folder)  # fmt: skip
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
            names, lists = [frames[n] for n in run], [listed[n] for n in run]
            material = [one.get("label.material") for one in lists]
            tests = ["+".join(name for name in TASKS if one.get(name) == "test") for one in lists]
            index.add(
                [f"{folder}/gelsight_frame/{name}" for name in names],
                sensor="gelsight",
                sequence=f"{Path(folder).name}/{run[0]}",
                frame_index=run,
                split=lists[0].get(task, unlisted),
                image_path=index.photographs(f"{folder}/video_frame", names, photos),
                background_path=before and f"{folder}/gelsight_frame/{before}",
                **{
                    "label.material": material,
                    "label.hardness": [None if m is None else "soft" if m in SOFT else "hard" for m in material],
                    "label.rough": [one.get("label.rough") for one in lists],
                    "label.contact": 1,
                    "downstream_test": [test or None for test in tests],
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


READERS = {
    "touch_and_go": DatasetReader(
        read,
        "dataset/<video>/gelsight_frame/0000000000.jpg",
        "Yang et al., Touch and Go: Learning from Human-Collected Vision and Touch, NeurIPS 2022",
        url="https://touch-and-go.github.io",
        uses=("lists", "task"),
        paper=250_000,
    )
}
