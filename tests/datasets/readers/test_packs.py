import numpy as np
from reader_world import fill
from refused import refused

from anytouch_jax.data.images import decode
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.datasets.readers import index


def test_real_touch_is_checked_and_rewritten(tmp_path, read):
    fill(tmp_path, ["a/0.png", "a/1.png", "a/bg.png"])
    head = (
        "path,sensor,sequence,frame_index,split,dataset,license,commercial,background_path,"
        "image_path,label.slip\n"
    )
    lines = [f"a/{i}.png,digit,a,{i},train,x,MIT,1,a/bg.png,a/lost.png,{i}\n" for i in range(3)]
    (tmp_path / "manifest.csv").write_text(head + "".join(lines))
    table = read("real_touch")
    assert len(table.rows) == 2
    assert table.rows["a/1.png"]["label.slip"] == 1
    assert table.rows["a/1.png"]["background_path"] == "a/bg.png"
    lost = {
        "file of the manifest that is not on disk": 1,
        "image_path that is not on disk (kept without)": 2,
    }
    assert table.reasons == lost
    refused("the pack's own manifest", index, "real_touch", tmp_path, tmp_path / "manifest.csv")
    (tmp_path / "manifest.csv").write_text(head + lines[0] + lines[0])
    refused("repeats frame_index 0", read, "real_touch")


def test_taxim_presses_become_images(tmp_path, read):
    calib = tmp_path / "calib"
    images = np.zeros((5, 6, 8, 3), np.uint8)
    # blue: the pack is BGR
    images[:, :, :, 0] = np.arange(5, dtype=np.uint8)[:, None, None]
    (calib / "gelsight").mkdir(parents=True)
    place = {"touch_center": np.ones((5, 2)), "touch_radius": np.arange(5)}
    np.savez(calib / "gelsight/dataPack.npz", f0=images[0], imgs=images, **place)
    root = tmp_path / "out"
    root.mkdir()
    table = read("taxim_presses", root, lists=calib, val=0, test=0)
    assert table.report.splits == {"train": 5, "background": 1}
    row = table.rows["taxim_presses/gelsight/press_03.png"]
    assert (row["label.radius_px"], row["label.contact"]) == (3.0, 1)
    assert decode(manifests.read(table.report.out).file(3))[0, 0].tolist() == [0, 0, 3]
    assert table.reasons == {"sensor without dataPack.npz": 1}
    (calib / "gelsight/dataPack.npz").write_bytes(b"broken")
    refused(r"dataPack.npz is not a calibration pack", read, "taxim_presses", root, lists=calib)
