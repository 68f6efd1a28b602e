"""Small manifests for checks and repairs."""

import cv2
import numpy as np

from anytouch_jax.data.manifest import manifest as manifests


def finding_rows(report):
    """The rows of each finding by its kind."""
    return {finding.kind: finding.rows.tolist() for finding in report.findings}


def patterned(image):
    """The image u8 (h, w, 3) with a faint ramp over it."""
    height, width = image.shape[:2]
    ramp = np.add.outer(np.arange(height) * 30 // height, np.arange(width) * 20 // width)[..., None]
    return np.clip(image + ramp, 0, 255).astype(np.uint8)


def with_patterns(make):
    """The fixture `make`, with a pattern over every image, because images of one colour are a
    finding.
    """

    def build(rows, folder="."):
        manifest = make(rows, folder)
        names = [
            name
            for name in ("path", "image_path", "image2_path")
            if name in manifest.table.column_names
        ]
        for file in {
            manifest.file(row, name)
            for name in names
            for row in np.flatnonzero(manifest.present(name))
        }:
            cv2.imwrite(str(file), patterned(cv2.imread(str(file))))
        return manifest

    return build


def columns(count=1, **more):
    """The columns that every manifest has, of `count` frames of one sequence, and `more`."""
    names = [f"{i}.png" for i in range(count)]
    usual = {
        "path": names,
        "sensor": ["digit"] * count,
        "sequence": ["s"] * count,
        "frame_index": list(range(count)),
    }
    return usual | {"split": ["train"] * count} | more


def plain_rows(count=6, **extra):
    """`count` rows of one dataset, in sequences of three frames."""
    return [
        {"sequence": f"s{i // 3}", "frame_index": i % 3, "dataset": "d", **extra}
        for i in range(count)
    ]


def image_pairs(tmp_path, make, *, swap, witness, count=24):
    """Touch: a gel's colours with a faint dent.

    Vision: anything. Rows where `swap` have the two exchanged.
    """
    rng = np.random.default_rng(3)
    gel = cv2.resize(
        rng.integers(60, 190, (3, 4, 3), np.uint8), (32, 24), interpolation=cv2.INTER_CUBIC
    )
    rows = [
        {
            "path": f"touch{i}.png",
            "image_path": f"see{i}.png",
            "dataset": "tvl",
            "sequence": "s",
            "frame_index": i,
        }
        for i in range(count)
    ]
    if witness:
        rows.append(
            {"path": "ground.png", "split": "background", "dataset": "tvl", "sequence": "b"}
        )
    loose = make(rows)
    for i in range(count):
        dent = np.zeros((24, 32), np.int16)
        cv2.circle(dent, (int(rng.integers(32)), int(rng.integers(24))), 5, 40, -1)
        touch = np.clip(gel + dent[..., None] + rng.integers(-3, 4, gel.shape), 0, 255).astype(
            np.uint8
        )
        see = cv2.resize(
            rng.integers(0, 256, (3, 4, 3), np.uint8), (40, 30), interpolation=cv2.INTER_CUBIC
        )
        first, second = (see, touch) if swap(i) else (touch, see)
        cv2.imwrite(str(tmp_path / f"touch{i}.png"), first)
        cv2.imwrite(str(tmp_path / f"see{i}.png"), second)
    if witness:
        cv2.imwrite(str(tmp_path / "ground.png"), gel)
    return loose


def edit(file, source=None, rows=slice(None), drop=(), **columns):
    """Write rows of the manifest `source` (or `file` itself) to `file`, with other columns."""
    table = manifests.read(source or file).table
    full = {
        name: table[name].to_pylist()[rows] for name in table.column_names if name not in drop
    } | columns
    manifests.write(manifests.from_columns(full, file), file)
    return file
