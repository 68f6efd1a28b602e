import json

import pytest
from reader_world import fill

from anytouch_jax.errors import UserError


def test_cloth_has_its_properties(tmp_path, read):
    base = "Data_ICRA18/Data"
    fill(tmp_path, [f"{base}/{cloth}/t{k}/gelsight_frame/{i:04d}.png" for cloth in (11, 12) for k in (0, 1)
                    for i in range(4)])  # fmt: skip
    fill(tmp_path, [f"{base}/13/t0/gsframes/frame{i:06d}.jpg" for i in range(1, 4)])
    (tmp_path / base / "13/t1").mkdir()
    (tmp_path / base / "13/t1/GelSight_video.mp4").write_bytes(b"x")
    (tmp_path / "Data_ICRA18/cloth_metadata.json").write_text(json.dumps({"11": list(range(11)), "12": [0] * 11}))
    table = read("cloth")
    assert len(table.rows) == 19
    row = table.rows[f"{base}/11/t1/gelsight_frame/0003.png"]
    assert (row["object"], row["label.fuzziness"], row["label.textile_type"]) == ("11", 0, 10)
    assert table.rows[f"{base}/13/t0/gsframes/frame000002.jpg"]["label.textile_type"] is None
    assert table.reasons["cloth without properties (kept without labels)"] == 1
    assert table.reasons["video that is not unpacked (expected gelsight_frame/0000.png)"] == 1
    for wrong in ([1, 2], [None] * 11, [1.5] * 11, "eleven"):
        (tmp_path / "Data_ICRA18/cloth_metadata.json").write_text(json.dumps({"11": wrong}))
        with pytest.raises(UserError, match="cloth '11' must have 11 whole numbers"):
            read("cloth")
