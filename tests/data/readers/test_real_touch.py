import pytest
from reader_world import fill

from anytouch_jax.data.readers import index
from anytouch_jax.errors import UserError


def test_real_touch_is_checked_and_rewritten(tmp_path, read):
    fill(tmp_path, ["a/0.png", "a/1.png", "a/bg.png"])
    head = "path,sensor,sequence,frame_index,split,dataset,license,commercial,background_path,image_path,label.slip\n"
    lines = [f"a/{i}.png,digit,a,{i},train,x,MIT,1,a/bg.png,a/lost.png,{i}\n" for i in range(3)]
    (tmp_path / "manifest.csv").write_text(head + "".join(lines))
    table = read("real_touch")
    assert len(table.rows) == 2
    assert table.rows["a/1.png"]["label.slip"] == 1
    assert table.rows["a/1.png"]["background_path"] == "a/bg.png"
    assert table.reasons == {
        "file of the manifest that is not on disk": 1,
        "image_path that is not on disk (kept without)": 2,
    }
    with pytest.raises(UserError, match="the pack's own manifest"):
        index("real_touch", tmp_path, tmp_path / "manifest.csv")
    (tmp_path / "manifest.csv").write_text(head + lines[0] + lines[0])
    with pytest.raises(UserError, match="repeats frame_index 0"):
        read("real_touch")
