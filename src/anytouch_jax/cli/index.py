"""`anytouch data index`: a manifest of a downloaded dataset."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from anytouch_jax.config.parsing import NotNegative, Share


@dataclass(frozen=True)
class DatasetOptions:
    """Make a manifest of a downloaded dataset or of your recordings: one row per tactile frame.

    Example: anytouch data index ycb_slide ~/data/YCB-Slide --out ~/data/YCB-Slide/ycb_slide.parquet

    Datasets: touch_and_go, visgel, cloth, objectfolder_real, tvl, ssvtp, ycb_slide, octopi, tacquad, feel,
    objectfolder, real_touch, taxim_presses, gelsight_mini_pretrain, fota, tacbench_force, tacbench_pose, touchd_force,
    freetacman, webdataset, lerobot, bags, recordings. Use recordings for your data: a folder of pictures for each
    recording, as OBJECT/RECORDING/0.png. Put background.png, photo.jpg and caption.txt there or in a folder above.
    """

    name: Positional[str]  # Name of the dataset.
    root: Positional[Path]  # Folder that holds the unpacked dataset.
    out: Path | None = None
    """Manifest to write, .parquet or .csv, in ROOT or a folder above it (default: ROOT/NAME.parquet)."""
    keep: bool = False  # Keep your edits of the manifest OUT: columns, splits, texts and labels, matched by path.
    val: Share = 0.05  # Share of the objects or recordings in split val, for a dataset without splits.
    test: Share = 0.05  # Share of the objects or recordings in split test, for a dataset without splits.
    lists: Path | None = None  # Folder of the dataset's list files, if they are not in ROOT.
    task: Literal["material", "rough"] = "material"  # touch_and_go: the task whose lists decide the split.
    fold: NotNegative[int] = 0  # feel: the fold k whose split_<k>.npy decides the split.
    export: bool = False  # Let the reader write pictures into ROOT, for a dataset of arrays or videos.
    sensor: str | None = None
    """recordings, webdataset, lerobot, bags: the sensor, by its name in the configuration or a new name."""
    split_by: str | None = None
    """recordings: what is held out: object, recording (a single picture is one), a column of the labels, or the part of
    the path in the parentheses of a pattern, as '(p[0-9]+)_'. Default: object. For single pictures: recording."""
    singles: bool = False  # recordings: every picture is a touch alone. By default names decide, and a few pictures.
    films: bool = False  # recordings: every folder of pictures is a film.
    order: Literal["names", "times"] = "names"  # recordings: order frames by their names, or by the times of the files.
    labels: Path | None = None
    """recordings: CSV table with a column object, sequence or both. Each other column becomes label.NAME, but unit,
    touch and text keep their names."""
    url: str | None = None  # gelsight_mini_pretrain, fota, webdataset: address of the shards, as s3://BUCKET/FOLDER.
    keys: tuple[str, ...] = ()
    """lerobot, freetacman: tactile cameras. bags: topics of tactile images. webdataset: fields, as left.jpg."""
    values: tuple[str, ...] = ()
    """lerobot: features that become labels. bags: labels from other topics, as force_z=/ft:wrench.force.z."""


def run(options: DatasetOptions) -> int:
    """Read the dataset, write its manifest, and print the counts with the paper's."""
    from anytouch_jax.cli.output import log
    from anytouch_jax.data import readers

    place = ("name", "root", "out", "keep")
    settings = readers.IndexOptions(**{name: value for name, value in vars(options).items() if name not in place})
    report = readers.index(options.name, options.root, options.out, options=settings, keep=options.keep)
    if report.written:
        log(f"{report.written:,} pictures were written into {options.root}")
    print("\n".join(report.lines()))
    return 0
