"""HDF5 and zarr become manifests: cameras, recordings, labels and splits of the usual layouts."""

import os
from collections import Counter

import cv2
import h5py
import numpy as np
import pytest
import zarr
from reader_world import Table
from refused import refused

from anytouch_jax.cli.app import main
from anytouch_jax.data import containers
from anytouch_jax.data.images import decode
from anytouch_jax.datasets.readers import IndexOptions, index

RNG = np.random.default_rng(0)
LENGTHS = (4, 3, 5, 4, 3, 4)


@pytest.fixture(autouse=True)
def closed():
    yield
    containers.close_containers()


def frames(count, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (count, 24, 32, 3), np.uint8)


def read(name, root, **options):
    """Index twice, which must give the same, and return the table."""
    options = IndexOptions(sensor="digit", **options)
    table = Table(index(name, root, options=options))
    assert index(name, root, options=options).manifest.content_hash == table.manifest.content_hash
    of_episode = {(row["episode"], row["split"]) for row in table.rows.values()}
    assert len(of_episode) == len({row["episode"] for row in table.rows.values()})
    return table


def make_robomimic(path):
    """Six demos of robomimic with a tactile camera, a camera of the scene, and actions."""
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["env_args"] = "settings " * 100
        data.attrs["robot"] = "panda"
        for number, length in enumerate(LENGTHS):
            demo = data.create_group(f"demo_{number}")
            demo.attrs["object"] = ("mug", "ball")[number % 2]
            demo.attrs["pose"] = np.arange(2.0)
            demo["success"] = number % 3 == 0
            demo["actions"] = RNG.normal(size=(length, 7))
            demo["obs/force"] = np.arange(length, dtype=np.float32)[:, None] + [0, 10 * number]
            demo["obs/tactile_left"] = frames(length, number)
            demo["obs/front"] = frames(length, 10 + number)
            demo["next_obs/tactile_left"] = frames(length, number)


def make_replay(path):
    """Write a replay buffer of diffusion policy with six episodes, and return its pixels."""
    pixels = np.concatenate([frames(length, n) for n, length in enumerate(LENGTHS)])
    is_zip = path.suffix == ".zip"
    store = zarr.storage.ZipStore(path, mode="w") if is_zip else str(path)
    group = zarr.open_group(store, mode="w", zarr_format=2)
    first = np.moveaxis(pixels, -1, 1).astype(np.float32)
    group.create_array("data/camera0_tactile", data=first, chunks=(5, 3, 24, 32))
    group.create_array("data/camera1_rgb", data=pixels)
    group.create_array("data/action", data=np.arange(len(pixels), dtype=np.float32)[:, None])
    group.create_array("meta/episode_ends", data=np.cumsum(LENGTHS))
    group.create_array("meta/episode_object", data=np.arange(6))
    group.attrs["material"] = "steel"
    if is_zip:
        store.close()
    return pixels


@pytest.fixture
def robomimic(tmp_path):
    make_robomimic(tmp_path / "demo.hdf5")
    return tmp_path / "demo.hdf5"


def test_a_file_of_robomimic(robomimic):
    table = read("hdf5", robomimic, val=0.3, test=0.3)
    assert table.report.out == robomimic.with_suffix(".parquet")
    assert Counter(table["sequence"]) == {
        f"demo.hdf5/data/demo_{n}/obs/tactile_left": length for n, length in enumerate(LENGTHS)
    }
    for path, row in table.rows.items():
        demo = int(row["sequence"].split("demo_")[1].split("/")[0])
        assert path == f"{row['sequence']}/{row['frame_index']}"
        wanted = frames(LENGTHS[demo], demo)[row["frame_index"]]
        np.testing.assert_array_equal(decode(robomimic.parent / path), wanted)
        assert row["unit"] == "obs/tactile_left"
        assert row["label.object"] == row["object"] == ("mug", "ball")[demo % 2]
        assert row["label.success"] == int(demo % 3 == 0) and row["label.robot"] == "panda"
        assert [row["label.pose_0"], row["label.pose_1"]] == [0, 1]
    # each object is in each split
    assert len({(row["object"], row["split"]) for row in table.rows.values()}) == 6
    notes = " ".join(table.report.notes)
    assert "env_args" in notes and "actions" in notes and "next_obs" not in notes


def test_a_file_whose_name_is_not_utf8_is_one_sentence(robomimic):
    named = robomimic.with_name(os.fsdecode(b"demo\xff.hdf5"))
    robomimic.rename(named)
    options = IndexOptions(sensor="digit", keys=("obs/tactile_left",))
    refused(r"the name 'demo\\udcff.hdf5' is not UTF-8", index, "hdf5", named, options=options)


def test_keys_choose_cameras_and_values_make_labels(robomimic):
    for words in (("obs/front",), ("front",), ("data/demo_*/obs/front",), ("*front",)):
        table = read("hdf5", robomimic, keys=words, values=("force",))
        assert set(table["unit"]) == {"obs/front"}
    both = read("hdf5", robomimic, keys=("obs/front", "tactile_left"), values=("obs/force",))
    assert Counter(both["unit"]) == {"obs/front": 23, "obs/tactile_left": 23}
    for row in both.rows.values():
        assert row["label.obs/force_0"] == row["frame_index"]
    for row in table.rows.values():
        demo = int(row["sequence"].split("demo_")[1].split("/")[0])
        assert row["label.force_1"] - 10 * demo == row["frame_index"]
    options = {"sensor": "digit"}
    for words, wrong in (
        (r"no camera obs/gone; choose .* obs/front, obs/tactile_left", {"keys": ("obs/gone",)}),
        (r"no array gone; --values takes actions, obs/force", {"values": ("gone",)}),
        (r"--sensor", {"sensor": None}),
        (r"does not use the option export", {"export": True}),
    ):
        refused(words, index, "hdf5", robomimic, options=IndexOptions(**options | wrong))


def test_lists_of_robomimic_are_its_splits(robomimic):
    with h5py.File(robomimic, "a") as file:
        file["mask/train"] = np.array([f"demo_{n}" for n in range(4)], "S")
        file["mask/valid"] = np.array(["demo_4"], "S")
        file["mask/20_percent"] = np.array(["demo_5"], "S")
    table = read("hdf5", robomimic)
    splits = {
        int(e.split("_")[-1]): s for e, s in zip(table["episode"], table["split"], strict=True)
    }
    assert splits == dict.fromkeys(range(4), "train") | {4: "val", 5: "unused"}


@pytest.mark.filterwarnings("ignore:Duplicate name")  # of zarr, which writes groups twice
@pytest.mark.parametrize("name", ["replay.zarr", "replay.zarr.zip"])
def test_a_replay_buffer(tmp_path, name):
    path = tmp_path / name
    pixels = make_replay(path)
    table = read("zarr", path, values=("action",))
    assert table.report.out == tmp_path / "replay.parquet"
    assert Counter(Counter(table["episode"]).values()) == Counter(LENGTHS)
    start = np.cumsum((0, *LENGTHS))
    for at, (place, row) in enumerate(table.rows.items()):
        episode = int(row["episode"][-6:])
        assert start[episode] + row["frame_index"] == at == row["label.action"]
        np.testing.assert_array_equal(decode(tmp_path / place), pixels[at])
        assert (row["label.episode_object"], row["label.material"]) == (episode, "steel")
    assert set(table["split"]) == {"train", "val", "test"}
    assert len(table.clips(3)) == sum(length - 2 for length in LENGTHS)


@pytest.mark.parametrize("ends", [[3, 2], [3, 99], [[3]], [0.5], []])
def test_ends_that_do_not_fit_are_one_sentence(tmp_path, ends):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["data/touch"] = frames(6)
        file["meta/episode_ends"] = ends
    options = IndexOptions(sensor="digit")
    refused(r"a\.h5.*episode_ends", index, "hdf5", tmp_path / "a.h5", options=options)
    # a folder goes on with its other files
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file["touch"] = frames(6)
    table = Table(index("hdf5", tmp_path, options=options))
    assert len(table.manifest) == 6 and table.reasons == {"file that cannot be read": 1}


def test_a_folder_of_files_with_jpegs_of_two_cameras(tmp_path):
    for number in range(5):
        folder = tmp_path / "runs" / ("wood", "foam")[number % 2]
        folder.mkdir(parents=True, exist_ok=True)
        with h5py.File(folder / f"episode_{number}.h5", "w") as file:
            file.attrs["material"] = folder.name
            file.attrs["broken"] = number if number else "text"
            for camera in ("gelsight_left", "gelsight_right", "cam_high"):
                key = f"observations/images/{camera}"
                data = file.create_dataset(key, (3,), h5py.vlen_dtype(np.uint8))
                for row, frame in enumerate(frames(3, number)):
                    data[row] = cv2.imencode(".jpg", frame)[1]
            file["observations/images/background"] = frames(1, 99)[0]
    (tmp_path / "runs" / "notes.txt").write_text("no array")
    (tmp_path / "runs" / "cut.h5").write_bytes(b"\x89HDF")
    table = read("hdf5", tmp_path / "runs")
    assert set(table["unit"]) == {
        "observations/images/gelsight_left", "observations/images/gelsight_right",
    }  # fmt: skip
    assert len(table.manifest) == 30 and len(set(table["sequence"])) == 10
    assert set(table["split"]) == {"train", "val", "test"}
    for row in table.rows.values():
        assert row["episode"].startswith(row["label.material"])
        assert isinstance(row["label.broken"], str), "numbers and texts are texts"
        assert row["background_path"] == f"{row['episode']}/observations/images/background/0"
    assert table.reasons == {"file that cannot be read": 1}
    options = IndexOptions(sensor="digit")
    refused(r"cut\.h5 cannot be read", index, "hdf5", tmp_path / "runs/cut.h5", options=options)
    refused(r"there is no folder .*, or a file \.h5", index, "hdf5", tmp_path / "gone.h5")


def recordings_of(path, arrays):
    """Return the sequences of a file of arrays and how many frames they have."""
    with h5py.File(path, "w") as file:
        for key in arrays:
            file[key] = frames(1)[0] if "still" in key or key[-1].isdecimal() else frames(3)
    table = Table(index("hdf5", path, options=IndexOptions(sensor="digit", keys=("*",))))
    name = f"{path.name}/"
    rows = table.rows.values()
    episodes = {row["episode"].removeprefix(name) for row in rows}
    return episodes, Counter(row["sequence"].removeprefix(name) for row in rows)


@pytest.mark.parametrize(
    ("arrays", "episodes", "sequences"),
    [
        # sides of a robot are cameras, and objects are recordings
        (["left/rgb", "right/rgb"], {"a.h5"}, {"left/rgb": 3, "right/rgb": 3}),
        (["mug/rgb", "ball/rgb"], {"mug", "ball"}, {"mug/rgb": 3, "ball/rgb": 3}),
        (["mug/left/rgb", "mug/right/rgb"], {"a.h5"}, {"mug/left/rgb": 3, "mug/right/rgb": 3}),
        (["cam_0/rgb", "cam_1/rgb"], {"a.h5"}, {"cam_0/rgb": 3, "cam_1/rgb": 3}),
        ([f"cam_{n}/rgb" for n in range(5)], {f"cam_{n}" for n in range(5)}, None),
        (["o_1/trial_2/rgb", "o_1/trial_3/rgb"], {"o_1/trial_2", "o_1/trial_3"}, None),
        (["press_a/touch", "press_b/touch"], {"press_a", "press_b"}, None),
        # before and after are single images, and numbers count frames
        (["g/before_still", "g/after_still"], {"a.h5"}, {"g/before_still": 1, "g/after_still": 1}),
        ([f"touch/{n}" for n in (0, 2, 10)], {"a.h5"}, {"touch": 3}),
        ([f"demo_1/tactile/{n}" for n in (0, 2)], {"demo_1"}, {"demo_1/tactile": 2}),
    ],
)
def test_what_is_a_recording_and_what_a_camera(tmp_path, arrays, episodes, sequences):
    found, counts = recordings_of(tmp_path / "a.h5", arrays)
    assert found == episodes
    if sequences is not None:
        assert counts == sequences


def test_numbers_of_single_images_are_numbers_of_frames(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for number in (10, 2, 0):
            file[f"touch/frame_{number:04d}"] = frames(1, number)[0]
    table = read("hdf5", tmp_path / "a.h5")
    assert table["frame_index"] == [0, 2, 10]
    for path, row in table.rows.items():
        wanted = frames(1, row["frame_index"])[0]
        np.testing.assert_array_equal(decode(tmp_path / path), wanted)


def test_arrays_of_one_name_and_a_number_are_recordings(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for number in range(3):
            file[f"press_{number}"] = frames(2 + number, number)
    table = read("hdf5", tmp_path / "a.h5")
    assert Counter(table["episode"]) == {f"a.h5/press_{n}": 2 + n for n in range(3)}
    assert set(table["unit"]) == {"press"}


def test_without_a_tactile_name_the_cameras_are_listed(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["front"] = frames(3)
        file["wrist"] = frames(3)
    options = IndexOptions(sensor="digit")
    refused("--keys from front, wrist", index, "hdf5", tmp_path / "a.h5", options=options)
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file["images"] = frames(3)
    assert len(index("hdf5", tmp_path / "b.h5", options=options).manifest) == 3
    with h5py.File(tmp_path / "c.h5", "w") as file:
        file["force"] = np.zeros(3)
    refused("no array of images", index, "hdf5", tmp_path / "c.h5", options=options)


def test_from_hdf5_to_features_on_the_command_line(robomimic, tiny_run, capsys):
    assert main(["info", str(robomimic)]) == 0
    told = capsys.readouterr().out
    assert "key obs/tactile_left: 23 frames in 6" in told and "32 x 24 uint8" in told
    assert "labels of a recording: robot, object, pose, success" in told
    assert f"anytouch data index hdf5 {robomimic}" in told
    assert main(["data", "index", "hdf5", str(robomimic), "--sensor", "digit"]) == 0
    assert "labels found: robot 23, object 23" in capsys.readouterr().out
    out = robomimic.with_name("features.npz")
    manifest = robomimic.with_suffix(".parquet")
    words = ["embed", "--model", str(tiny_run), "--out", str(out), "--batch", "4", "--data"]
    assert main([*words, str(manifest)]) == 0
    with np.load(out) as features:
        assert features["features"].shape == (23, 12)
    assert main([*words, str(robomimic)]) == 2
    assert "anytouch data index hdf5" in capsys.readouterr().err
