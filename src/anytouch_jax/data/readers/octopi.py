"""Octopi's PhysiCLeAR (Yu et al., RSS 2024): a GelSight Mini pressed on and rubbed over 74 everyday objects.

Layout (the authors' repository): 476 videos `dataset/<object>_<k>.mov`. A script turns them into
`<output>/physiclear_<object>_<k>/%010d.jpg` (only frames that move, so numbers have gaps) and writes
`{train,val,test}_samples.json` (object -> folders). AnyTouch calls the output folder `processed`. No licence is stated.

The split is that of the JSON files, matched by folder name, if all three exist; else by hash of the object.
`contact_text_octopi.csv`, `contact_octopi.csv` or `contact.csv` marks the contact frames.
"""

from __future__ import annotations

from pathlib import Path

from anytouch_jax.data.readers.common import DatasetError, DatasetIndex, DatasetReader, read_json

LISTS = ("contact_text_octopi.csv", "contact_octopi.csv", "contact.csv")


def read(index: DatasetIndex) -> None:
    """Add every sample folder with frames. Raises DatasetError if there is none."""
    base = index.root / "processed" if (index.root / "processed").is_dir() else index.root
    prefix, samples = index.prefix(base), 0
    index.read_contact_list(LISTS, "processed")
    splits = _published_splits(index, base)
    for sample in index.listing(base)[0]:
        files = index.listing(base / sample)[1]
        if not files:
            index.skip("folder without files", f"{base / sample}")
            continue
        frames = index.numbered(files, r"(\d+)\.(?:jpe?g|png)", sample)
        samples += bool(frames)
        obj = sample.removeprefix("physiclear_").rpartition("_")[0] or sample
        split = splits.get(sample) or ("unused" if splits else index.split_of(obj))
        if splits and sample not in splits:
            index.skip("sample in no *_samples.json (split unused)", sample)
        cells = [(index.contact or {}).get(f"{sample}/{name}", [""]) for _, name in frames]
        index.add_recording(frames, f"{prefix}{sample}", split=split, key=sample, sensor="gelsight_mini",
                            sequence=sample, object=obj,
                            caption_id=[f"octopi_{row[1]}" if len(row) > 1 else None for row in cells])  # fmt: skip
    if not samples:
        raise DatasetError(f"expected processed/<sample>/0000000000.jpg under {index.root}; is ROOT the folder that "
                           "holds 'processed', and has Octopi's process_dataset.py been run?")  # fmt: skip


def _published_splits(index: DatasetIndex, base: Path) -> dict[str, str]:
    names = ("train", "val", "test")
    files = {split: index.find_file([f"{split}_samples.json"], base, base.parent) for split in names}
    if not all(files.values()):
        index.notes.append("no train_, val_ and test_samples.json: split by hash of the object")
        return {}
    splits: dict[str, str] = {}
    for split, path in files.items():
        assert path is not None
        for folder in (folder for folders in read_json(path, list).values() for folder in map(str, folders)):
            name = Path(folder.replace("\\", "/")).name
            if splits.setdefault(name, split) != split:
                raise DatasetError(f"{path}: the sample {name} is also in {splits[name]}_samples.json")
    return splits


READER = DatasetReader(
    read,
    url="https://github.com/clear-nus/octopi",
    citation="Yu et al., Octopi: Object Property Reasoning with Large Tactile-Language Models, RSS 2024",
    uses=("val", "test", "lists"),
    paper=39_000,
)
