from reader_world import fill


def test_ycb_slide_clips_take_every_third_frame(tmp_path, read):
    fill(tmp_path, [f"real/035_power_drill/dataset_{k}/frames/frame_{i:07d}.jpg" for k in (0, 4) for i in range(10)])
    fill(tmp_path, ["real/035_power_drill/dataset_0/webcam_frames/frame_0000000.jpg"])
    table = read("ycb_slide")
    assert set(table["stride"]) == {3}
    clips = [[table.rows[path]["frame_index"] for path in clip] for clip in table.clips(3)]
    assert clips == [[i - 6, i - 3, i] for i in range(6, 10)] * 2
    assert len(set(table["split"])) == 1  # one object
    assert not any("webcam" in path for path in table.rows)
