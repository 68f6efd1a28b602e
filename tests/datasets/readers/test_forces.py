import json
import pickle

import numpy as np
import pytest
from reader_world import fill
from refused import refused
from videos import write_video

from anytouch_jax.data.images import decode
from tests.data.manifest.test_containers import png


def write_batch(folder, sensor, *, split_forces=True):
    folder.mkdir(parents=True)
    frames = [png(10 * i) for i in range(8)]
    for part, own in enumerate((frames[:5], frames[5:])):
        (folder / f"dataset_{sensor}_{part:02d}.pkl").write_bytes(pickle.dumps(own))
    (folder / f"org_dataset_{sensor}_00.pkl").write_bytes(b"never read")
    slide = {
        "indexes": np.arange(2, 6),
        "forces": np.arange(12.0).reshape(4, 3),
        "slip_label": np.array([0, 0, 1, 1.0]),
    }
    content = {"in_contact": np.array([1, 0, 1, 1, 1, 1, 0, 0]), "trajectories": {0: slide}}
    (folder / "dataset_slip_forces.pkl").write_bytes(pickle.dumps(content, protocol=2))


def test_slides_of_tacbench_have_forces_and_slip(read, tmp_path):
    write_batch(tmp_path / "sphere" / "batch_1", "digit")
    write_batch(tmp_path / "flat" / "batch_1", "gelsight")
    refused("--export", read, "tacbench_force")
    table = read("tacbench_force", export=True)
    used = [row for row in table.rows.values() if row["split"] != "unused"]
    assert [row["split"] for row in used] == ["test"] * 4 + ["train"] * 4
    assert [row["sensor"] for row in used[::4]] == ["gelsight_mini", "digit"]
    labels = [(row["label.force_z"], row["label.slip"]) for row in used[:4]]
    assert labels == [(2, 0), (5, 0), (8, 1), (11, 1)]
    assert (
        used[0]["background_path"] == "flat/batch_1/frames/000001.png"
        and used[0]["object"] == "flat"
    )
    assert decode(tmp_path / used[2]["path"])[0, 0, 0] == 40
    assert len(table.clips(3)) == 4 and len(table.rows) == 16
    assert table.report.reader.license == "CC-BY-NC-4.0"


class Harm:
    def __reduce__(self):
        return print, ("harm",)


@pytest.mark.parametrize("content", [Harm(), [np.array([Harm()], object)]])
def test_a_pickle_that_runs_code_is_refused(read, tmp_path, capsys, content):
    write_batch(tmp_path / "sphere" / "batch_1", "digit")
    (tmp_path / "sphere" / "batch_1" / "dataset_digit_00.pkl").write_bytes(pickle.dumps(content))
    refused("no pickle of plain values", read, "tacbench_force", export=True)
    assert "harm" not in capsys.readouterr().out


def test_poses_of_three_fingers(read, tmp_path):
    turn = np.radians(20)
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    pose[:3, 3] = 1, 2, 3
    for part in ("train", "test"):
        bag = {
            f"digit_{finger}": [png(i) for i in range(4)] for finger in ("index", "middle", "ring")
        }
        bag |= {
            f"object_{finger}_rel_pose_n5": np.stack([pose] * 3)
            for finger in ("index", "middle", "ring")
        }
        (tmp_path / part / "sugar").mkdir(parents=True)
        (tmp_path / part / "sugar" / "bag_00.pkl").write_bytes(pickle.dumps(bag))
    fill(tmp_path, ["bgs/digit_ring.png"])
    table = read("tacbench_pose", export=True)
    assert len(table.rows) == 18 and set(table["split"]) == {"train", "test"}
    assert set(table["unit"]) == {"index", "middle", "ring"}
    row = table.rows["train/sugar/bag_00/ring/000002.png"]
    assert (row["label.t_x"], row["label.t_y"]) == (2, 1) and row["label.yaw"] == pytest.approx(20)
    assert row["background_path"] == "bgs/digit_ring.png" and row["object"] == "sugar"


def test_forces_of_touchd(read, tmp_path):
    places = {"obj41_speed1": "train", "obj22_speed1": "test"}
    content = {
        place: {"digit_1": [[2, 0.1, 0.2, -3.0], [4, 0, 0, -1.0], [9, 0, 0, 0]]} for place in places
    }
    (tmp_path / "all_data_direction.json").write_text(json.dumps(content))
    fill(tmp_path, [f"{place}/digit_1/image_{i}.png" for place in places for i in (1, 2, 3, 4)])
    table = read("touchd_force")
    row = table.rows["obj41_speed1/digit_1/image_2.png"]
    assert (row["label.force_x"], row["label.force_z"], row["sensor"], row["stride"]) == (
        0.1,
        3.0,
        "digit",
        2,
    )
    assert row["background_path"] == "obj41_speed1/digit_1/image_1.png" and row["object"] == "obj41"
    assert {row["object"]: row["split"] for row in table.rows.values()} == {
        "obj41": "train",
        "obj22": "test",
    }
    assert (
        table.reasons == {"image of the table that is not on disk": 2} and len(table.clips(2)) == 2
    )


def test_videos_of_freetacman(read, tmp_path):
    for camera in ("front", "tactile_left"):
        frames = [np.full((32, 32, 3), 40 * i, np.uint8) for i in range(5)]
        write_video(tmp_path / f"Cast/Cast_1_{camera}.mp4", frames, 30)
    times = tmp_path / "Cast" / "Cast_1_tactile_left_timestamps.txt"
    times.write_text("".join(f"{100 + i / 30}\n" for i in range(5)))
    poses = "".join(f"{i},{0.1 * i},{40 - i},up\n" for i in range(5))
    (tmp_path / "Cast" / "Cast_1_traj.csv").write_text(
        f"timestamp,TCP_x,gripper_distance,note\n{poses}"
    )
    refused("--export", read, "freetacman")
    table = read("freetacman", export=True)
    assert (
        len(table.rows) == 5
        and set(table["unit"]) == {"tactile_left"}
        and set(table["object"]) == {"Cast"}
    )
    assert (
        table["time"][4] == pytest.approx(100 + 4 / 30)
        and "video of another camera" in table.reasons
    )
    assert table["label.gripper_distance"] == [40, 39, 38, 37, 36]
    assert "label.note" not in table.report.manifest.table.column_names
    assert len(table.clips(3)) == 3
    (tmp_path / "Cast" / "Cast_1_traj.csv").write_text(
        f"timestamp,TCP_x,gripper_distance,note\n{poses}5,0,0,up\n"
    )
    times.write_text(times.read_text() + "101\n")
    reasons = read("freetacman", export=True).reasons
    assert sum(reasons[one] for one in reasons if one.endswith(": 6, not 5")) == 2
