"""SSVTP (Kerr et al., RSS 2023): a robot presses a DIGIT on textiles and photographs the same place; stills only.

Seen: the card of the TVL dataset, which carries it: `ssvtp/images_tac/image_<id>_tac.jpg`,
`ssvtp/images_rgb/image_<id>_rgb.jpg`, `text/labels_<id>.txt`, `train.csv` and `test.csv` (columns tactile and caption,
T3). No licence of the data was found.

Every picture is a sequence of its own. The split is that of test.csv where it is there, else by hash of the id.
`caption_id` is the name of its long caption in TacQuad's download.
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
    find_folder,
    hash_split,
    listing,
    numbered,
    read_table,
)


def read(root: Path, options: IndexOptions, notes: Notes) -> Columns:
    """Every tactile picture with its photograph and phrase. Raises DatasetError without `images_tac`."""
    base = find_folder(root, "tvl_dataset/ssvtp", "ssvtp", "ssvtp_data", ".", inside=("images_tac",))
    prefix = "" if base == root else f"{base.relative_to(root).as_posix()}/"
    frames = numbered(listing(base / "images_tac", notes)[1], r"image_(\d+)_tac\.(?:jpe?g|png)", notes, "images_tac")
    rgb = listing(base / "images_rgb", notes)[1] if (base / "images_rgb").is_dir() else []
    photos = dict(numbered(rgb, r"image_(\d+)_rgb\.(?:jpe?g|png)", notes, "images_rgb"))
    ids = [number for number, _ in frames]
    notes.skip("photograph missing (kept without)", "images_rgb", sum(number not in photos for number in ids))
    notes.skip("photograph without touch", "images_rgb", len(photos.keys() - set(ids)))
    tests, captions = _tables(base, notes)
    rows = RowBuilder("image_path", "text", "caption_id")
    rows.add(
        [f"{prefix}images_tac/{name}" for _, name in frames],
        sensor="digit",
        sequence=[f"image_{number}" for number in ids],
        frame_index=0,
        split=[("test" if name in tests else "train") if tests else hash_split("ssvtp", str(number), options)
               for number, name in frames],
        image_path=[f"{prefix}images_rgb/{photos[number]}" if number in photos else None for number in ids],
        text=[captions.get(name) for _, name in frames],
        caption_id=[f"ssvtp_{number}" for number in ids],
    )  # fmt: skip
    return rows.columns()


def _tables(base: Path, notes: Notes) -> tuple[set[str], dict[str, str]]:
    """Names of the test pictures, and phrases by name."""
    tests, captions = set(), {}
    for split in ("train", "test"):
        path = base / f"{split}.csv"
        if not path.is_file():
            notes.log(f"no {split}.csv: no phrases{' and no test pictures' if split == 'test' else ''} of it")
            continue
        for row in read_table(path):
            if "tactile" not in row:
                raise DatasetError(f"{path}: expected a column 'tactile', found {', '.join(row)}")
            name = Path(row["tactile"]).name
            captions[name] = row.get("caption") or None
            if split == "test":
                tests.add(name)
    return tests, {name: text for name, text in captions.items() if text}


READER = DatasetReader(
    name="ssvtp",
    read=read,
    sensor="digit",
    license="not stated",
    commercial=False,
    about="a DIGIT pressed on textiles, with photographs and short phrases; stills only",
    url="https://sites.google.com/berkeley.edu/ssvtp",
    citation="Kerr et al., Self-Supervised Visuo-Tactile Pretraining to Locate and Follow Garment Features, RSS 2023",
    paper=4_500,
)
