"""Octopi's PhysiCLeAR (Yu et al., RSS 2024): a GelSight Mini pressed on and rubbed over 74 everyday objects.

Seen: the authors' repository: 476 videos `dataset/<object>_<k>.mov`, and the script that turns them into
`<output>/physiclear_<object>_<k>/%010d.jpg` (only frames that move, so numbers have gaps) and writes
`{train,val,test}_samples.json` (object -> folders). AnyTouch calls the output folder `processed`. No licence is stated.

The split is that of the JSON files, matched by the folder's name, where all three are there; else by hash of the
object. `contact_text_octopi.csv` / `contact_octopi.csv` / `contact.csv` mark the contact frames where they are there.
"""

from __future__ import annotations

from pathlib import Path

from anytouch_jax.data.readers.common import (
    Columns,
    DatasetError,
    DatasetReader,
    IndexOptions,
    Notes,
    RowBuilder,
    add_recording,
    contact_list,
    find_file,
    hash_split,
    listing,
    miss_listed,
    numbered,
    read_json,
)

LISTS = ("contact_text_octopi.csv", "contact_octopi.csv", "contact.csv")
FRAME = r"(\d+)\.(?:jpe?g|png)"


def read(root: Path, options: IndexOptions, notes: Notes) -> Columns:
    """Every sample folder with frames. Raises DatasetError when there is none."""
    base = root / "processed" if (root / "processed").is_dir() else root
    place = "processed/" if base != root else ""
    listed = contact_list(root, options, LISTS, "processed")
    own = _own_splits(base, options, notes)
    rows = RowBuilder("object", "caption_id", "label.contact")
    found = samples = 0
    for sample in listing(base, notes)[0]:
        files = listing(base / sample, notes)[1]
        if not files:
            notes.skip("folder without files", f"{base / sample}")
            continue
        frames = numbered(files, FRAME, notes, sample)
        samples += bool(frames)
        obj = sample.removeprefix("physiclear_").rpartition("_")[0] or sample
        split = own.get(sample) or ("unused" if own else hash_split("octopi", obj, options))
        if own and sample not in own:
            notes.skip("sample in no *_samples.json (split unused)", sample)
        cells = [(listed or {}).get(f"{sample}/{name}", [""]) for _, name in frames]
        found += add_recording(rows, frames, f"{place}{sample}", split=split, listed=listed, key=sample,
                               sensor="gelsight_mini", sequence=sample, object=obj,
                               caption_id=[f"octopi_{row[1]}" if len(row) > 1 else None for row in cells])  # fmt: skip
    if not samples:
        raise DatasetError(f"expected processed/<sample>/0000000000.jpg under {root}; is ROOT the folder that holds "
                           "'processed', and has Octopi's process_dataset.py been run?")  # fmt: skip
    miss_listed(notes, listed, found)
    return rows.columns()


def _own_splits(base: Path, options: IndexOptions, notes: Notes) -> dict[str, str]:
    files = {split: find_file([f"{split}_samples.json"], options.lists, base, base.parent) for split in
             ("train", "val", "test")}  # fmt: skip
    if not all(files.values()):
        notes.log("no train_, val_ and test_samples.json: split by hash of the object")
        return {}
    own: dict[str, str] = {}
    for split, path in files.items():
        assert path is not None
        for folder in (folder for folders in read_json(path, list).values() for folder in map(str, folders)):
            name = Path(folder.replace("\\", "/")).name
            if own.setdefault(name, split) != split:
                raise DatasetError(f"{path}: the sample {name} is also in {own[name]}_samples.json")
    return own


READER = DatasetReader(
    name="octopi",
    read=read,
    sensor="gelsight_mini",
    license="not stated",
    commercial=False,
    about="PhysiCLeAR: presses and rubs of 74 objects",
    url="https://github.com/clear-nus/octopi",
    citation="Yu et al., Octopi: Object Property Reasoning with Large Tactile-Language Models, RSS 2024",
    uses=("val", "test", "lists"),
    paper=39_000,
)
