"""The real recordings that the shipped encoders are trained on: a copy of what two packs of real
touch allow.

    python -m experiments.encoders.real ../shared/real_touch2 ../shared/real_touch --out data/real

Taken are train rows of a GelSight Mini or a 9DTact, with a background and a licence for commercial
use. The slip clips of the first pack are left out, since the second pack has them with other
splits. A touch of the second pack is a group of grasps: recordings of one object, by either finger,
whose contact images agree.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Callable
from pathlib import Path

import cv2

Row = dict[str, str]
SLIP = "incipient_slip-gelsight_mini_markers"
SHORT = 144  # pixels
TOUCHED = 5.0  # of label.contact_score in the second pack. The rows of the first are all presses.


def copy(
    pack: Path, out: Path, keep: Callable[[Row], bool], contact: Callable[[Row], bool]
) -> Path:
    """Copy the train rows of a pack that `keep` allows, with their images and a label.contact."""
    with (pack / "manifest.csv").open(encoding="utf-8", newline="") as file:
        rows = [
            row
            for row in csv.DictReader(file)
            if row["split"] == "train" and row["background_path"] and keep(row)
        ]
    for row in rows:
        row["label.contact"] = str(int(contact(row)))
        if contact(row) and row.get("grasp_group"):
            row["touch"] = row["grasp_group"]
        for name in ("path", "background_path", "image_path"):
            if row[name] and not (out / row[name]).exists():
                (out / row[name]).parent.mkdir(parents=True, exist_ok=True)
                _shrink(pack / row[name], out / row[name])
    with (out / "manifest.csv").open("w", encoding="utf-8", newline="") as file:
        table = csv.DictWriter(file, fieldnames=list(rows[0]))
        table.writeheader()
        table.writerows(rows)
    return out / "manifest.csv"


def _shrink(source: Path, target: Path) -> None:
    """Write an image with a short side of SHORT pixels at most, so that all of them fit an
    upload.
    """
    image = cv2.imread(str(source))
    scale = min(1.0, SHORT / min(image.shape[:2]))
    image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    cv2.imwrite(
        str(target), image, [cv2.IMWRITE_JPEG_QUALITY, 88] if target.suffix == ".jpg" else []
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("pack2", type=Path)
    parser.add_argument("pack1", type=Path)
    parser.add_argument("--out", type=Path, default=Path("data/real"))
    options = parser.parse_args()
    print(
        copy(
            options.pack2,
            options.out / "pack2",
            lambda row: row["sensor"] == "gelsight_mini",
            lambda row: float(row["label.contact_score"] or 0) > TOUCHED,
        ),
        copy(
            options.pack1,
            options.out / "pack1",
            lambda row: row["dataset"] != SLIP and row["commercial"] != "0",
            lambda row: True,
        ),
    )


if __name__ == "__main__":
    main()
