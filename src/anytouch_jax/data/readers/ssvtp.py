"""SSVTP (Kerr et al., RSS 2023): a robot presses a DIGIT on textiles and photographs the same place; stills only.

Layout (the card of the TVL dataset, which includes it): `ssvtp/images_tac/image_<id>_tac.jpg`,
`ssvtp/images_rgb/image_<id>_rgb.jpg`, `text/labels_<id>.txt`, `train.csv` and `test.csv` (columns tactile and caption,
T3). No licence of the data was found.

Every picture is a sequence. The split is that of test.csv, else by hash of the id. `caption_id` is the name of the
long caption in TacQuad's download.
"""

from __future__ import annotations

from pathlib import Path

from anytouch_jax.data.readers.common import DatasetIndex, DatasetReader, read_table


def read(index: DatasetIndex) -> None:
    """Add every tactile picture with its photograph and phrase. Raises DatasetError without `images_tac`."""
    base = index.find_folder("tvl_dataset/ssvtp", "ssvtp", "ssvtp_data", ".", inside=("images_tac",))
    prefix = index.prefix(base)
    frames = index.numbered(index.listing(base / "images_tac")[1], r"image_(\d+)_tac\.(?:jpe?g|png)", "images_tac")
    rgb = index.listing(base / "images_rgb")[1] if (base / "images_rgb").is_dir() else []
    photos = dict(index.numbered(rgb, r"image_(\d+)_rgb\.(?:jpe?g|png)", "images_rgb"))
    ids = [number for number, _ in frames]
    index.skip("photograph missing (kept without)", "images_rgb", sum(number not in photos for number in ids))
    index.skip("photograph without touch", "images_rgb", len(photos.keys() - set(ids)))
    tests, captions = _tables(index, base)
    index.add(
        [f"{prefix}images_tac/{name}" for _, name in frames],
        sensor="digit",
        sequence=[f"image_{number}" for number in ids],
        frame_index=0,
        split=[("test" if name in tests else "train") if tests else index.split_of(str(number))
               for number, name in frames],
        image_path=[f"{prefix}images_rgb/{photos[number]}" if number in photos else None for number in ids],
        text=[captions.get(name) for _, name in frames],
        caption_id=[f"ssvtp_{number}" for number in ids],
    )  # fmt: skip


def _tables(index: DatasetIndex, base: Path) -> tuple[set[str], dict[str, str]]:
    """Return the names of the test pictures, and phrases by name."""
    tests, captions = set(), {}
    for split in ("train", "test"):
        path = base / f"{split}.csv"
        if not path.is_file():
            index.notes.append(f"no {split}.csv: no phrases{' and no test pictures' if split == 'test' else ''} of it")
            continue
        for row in read_table(path, "tactile"):
            name = Path(row["tactile"]).name
            captions[name] = row.get("caption")
            if split == "test":
                tests.add(name)
    return tests, {name: text for name, text in captions.items() if text}


READER = DatasetReader(
    read,
    url="https://sites.google.com/berkeley.edu/ssvtp",
    citation="Kerr et al., Self-Supervised Visuo-Tactile Pretraining to Locate and Follow Garment Features, RSS 2023",
    paper=4_500,
)
