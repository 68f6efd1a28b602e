"""What is cut from a simulated data set, on a table without pictures."""

from __future__ import annotations

import numpy as np
import pytest

from anytouch_jax.data.manifest import manifest as manifests
from experiments.tables import cuts, plan

SENSORS = ("digit", "gelsight", plan.UNSEEN)
FRAMES = 11
SPLITS = ("train", "val", "test")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Nine touches by three sensors."""
    root = tmp_path_factory.mktemp("own")
    rows: list[dict[str, object]] = []
    for touch in range(9):
        for sensor in SENSORS:
            name = f"{touch}-{sensor}"
            for frame in range(FRAMES):
                rows.append(
                    {"path": f"{name}-{frame}.jpg", "sensor": sensor, "sequence": name, "frame_index": frame,
                     "split": SPLITS[touch // 3], "touch": str(touch), "unit": name, "object": f"o{touch}",
                     "label.force": float(5 - abs(frame - 5))}
                )  # fmt: skip
            rows.append(
                rows[-1] | {"path": f"{name}.jpg", "sequence": f"{name}-b", "split": "background", "touch": None}
            )
    columns = {key: [row[key] for row in rows] for key in rows[0]}
    manifests.write(manifests.from_columns(columns, root / cuts.WHOLE), root / cuts.WHOLE)
    cuts.cut_all(root)
    return root


def test_a_sensor_by_itself_has_touches_of_nobody(folder):
    table = manifests.read(folder / "digit.parquet")
    assert set(table.text_column("sensor")) == {"digit"} and len(table) == 9 * FRAMES
    assert not table.present("touch").any() and "background" not in table.text_column("split")
    assert len(table.clips(4, "train")) == 3 * (FRAMES - 3)


def test_static_is_the_deepest_frame_of_each_recording(folder):
    table = manifests.read(folder / cuts.STATIC)
    assert len(table) == 9 * len(SENSORS) and set(np.asarray(table.column("frame_index"))) == {5}
    assert table.present("touch").all()
