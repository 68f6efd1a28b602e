import numpy as np
import pytest

from anytouch_jax.data.images import decode
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.errors import UserError


def test_taxim_presses_become_pictures(tmp_path, read):
    calib = tmp_path / "calib"
    images = np.zeros((5, 6, 8, 3), np.uint8)
    images[:, :, :, 0] = np.arange(5, dtype=np.uint8)[:, None, None]  # blue: the pack is BGR
    (calib / "gelsight").mkdir(parents=True)
    np.savez(
        calib / "gelsight/dataPack.npz", f0=images[0], imgs=images, touch_center=np.ones((5, 2)),
        touch_radius=np.arange(5),
    )  # fmt: skip
    root = tmp_path / "out"
    root.mkdir()
    table = read("taxim_presses", root, lists=calib, val=0, test=0)
    assert table.report.splits == {"train": 5, "background": 1}
    row = table.rows["taxim_presses/gelsight/press_03.png"]
    assert (row["label.radius_px"], row["label.contact"]) == (3.0, 1)
    picture = manifests.read(table.report.out)

    assert decode(picture.file(3))[0, 0].tolist() == [0, 0, 3]
    assert table.reasons == {"sensor without dataPack.npz": 1}
    (calib / "gelsight/dataPack.npz").write_bytes(b"broken")
    with pytest.raises(UserError, match=r"dataPack.npz is not a calibration pack"):
        read("taxim_presses", root, lists=calib)
