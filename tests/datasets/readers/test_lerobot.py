import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
from refused import refused
from videos import write_video

from anytouch_jax.cli.app import main
from anytouch_jax.data.images import decode
from anytouch_jax.datasets.readers import IndexOptions, index, lerobot
from tests.data.manifest.test_containers import png
from tests.weights.test_start import mae

FPS = 10
LENGTHS = (5, 4, 3)
GEL = "observation.images.gel"
VIDEO = "observation.images.tactile_film"
SCENE = "observation.images.front"


def make(root):
    """Three episodes in two Parquet files and two videos: a gel in Parquet, a tactile video, a
    camera of the scene.
    """
    camera = {"shape": [32, 32, 3], "names": ["height", "width", "channels"]}
    features = {
        GEL: camera | {"dtype": "image"},
        VIDEO: camera | {"dtype": "video"},
        SCENE: camera | {"dtype": "video"},
    }
    features |= {"observation.force": {"dtype": "float32", "shape": [2], "names": None}}
    features |= {
        name: {"dtype": "int64", "shape": [1], "names": None}
        for name in ("frame_index", "episode_index")
    }
    info = {
        "codebase_version": "v3.0",
        "fps": FPS,
        "features": features,
        "total_episodes": 3,
        "total_frames": 12,
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
    }
    for folder in ("meta/episodes/chunk-000", "data/chunk-000"):
        (root / folder).mkdir(parents=True)
    (root / "meta" / "info.json").write_text(json.dumps(info))
    tasks = pa.table({"task_index": [0, 1], "__index_level_0__": ["press", "slide"]})
    pa.parquet.write_table(tasks, root / "meta" / "tasks.parquet")
    rows = {0: [], 1: []}
    episodes = []
    for episode, length in enumerate(LENGTHS):
        home = episode // 2  # file of data and of video
        first = len(rows[home])
        place = {"chunk_index": 0, "file_index": home}
        video = place | {"from_timestamp": first / FPS, "to_timestamp": (first + length) / FPS}
        about = {"episode_index": episode, "length": length, "stats/x": [0.5]}
        about |= {f"data/{end}": value for end, value in place.items()}
        about |= {
            f"videos/{key}/{end}": value for key in (VIDEO, SCENE) for end, value in video.items()
        }
        episodes.append(about)
        for frame in range(length):
            number = sum(LENGTHS[:episode]) + frame
            rows[home].append(
                {
                    GEL: {"bytes": png(10 * number), "path": None},
                    "observation.force": [float(number), -1.0],
                    "timestamp": frame / FPS,
                    "frame_index": frame,
                    "episode_index": episode,
                    "index": number,
                    "task_index": episode % 2,
                }
            )
    pa.parquet.write_table(
        pa.Table.from_pylist(episodes), root / "meta/episodes/chunk-000/file-000.parquet"
    )
    for home, own in rows.items():
        frames = [np.full((32, 32, 3), 20 * row["index"], np.uint8) for row in own]
        for key in (VIDEO, SCENE):
            write_video(root / "videos" / key / "chunk-000" / f"file-{home:03d}.mp4", frames, FPS)
        table = pa.Table.from_pylist(own).replace_schema_metadata({b"huggingface": b"{}"})
        pa.parquet.write_table(table, root / "data" / "chunk-000" / f"file-{home:03d}.parquet")
    return root


@pytest.fixture
def root(tmp_path):
    return make(tmp_path / "set")


def rows_of(root, **options):
    report = index("lerobot", root, options=IndexOptions(sensor="gelsight_mini", **options))
    return report.manifest, report.manifest.table.to_pylist()


def test_frames_of_parquet_and_video_have_the_indices_and_times_of_the_data_set(root):
    refused("--export", rows_of, root)
    manifest, rows = rows_of(root, export=True, values=("observation.force",))
    assert {row["unit"] for row in rows} == {GEL, VIDEO} and len(rows) == 24
    numbers = [number for number, length in enumerate(LENGTHS) for _ in range(length)]
    for key, factor in ((GEL, 10), (VIDEO, 20)):
        own = [(at, row) for at, row in enumerate(rows) if row["unit"] == key]
        assert [row["index"] for _, row in own] == list(range(12))
        assert [row["episode"] for _, row in own] == numbers
        assert [row["timestamp"] for _, row in own] == pytest.approx(
            [row["frame_index"] / FPS for _, row in own]
        )
        values = [int(decode(manifest.file(at)).mean()) for at, _ in own]
        # the video is lossy
        np.testing.assert_allclose(values, factor * np.arange(12), atol=4)
        assert [row["label.observation.force_0"] for _, row in own] == list(range(12))
    assert rows[0]["label.task"] == "press" and len(manifest.clips(3)) == 2 * (3 + 2 + 1)


def test_a_data_set_is_embedded_and_the_features_are_a_column(root, tmp_path, capsys):
    rows_of(root, keys=(GEL,))
    encoder = mae(tmp_path / "mae")
    out = tmp_path / "features.npz"
    words = [
        "embed",
        "--model",
        encoder,
        "--data",
        root / "lerobot.parquet",
        "--out",
        out,
        "--batch",
        4,
    ]
    words += ["--column", "observation.touch"]
    assert main(list(map(str, words))) == 0, capsys.readouterr().err
    with np.load(out) as file:
        features = file["features"]
        times = file["key/timestamp"]
        numbers = file["key/index"]
    for home in (0, 1):
        table = pa.parquet.read_table(root / "data" / "chunk-000" / f"file-{home:03d}.parquet")
        assert pa.types.is_fixed_size_list(table.schema.field("observation.touch").type)
        at = [int(np.flatnonzero(numbers == number)[0]) for number in table["index"].to_pylist()]
        np.testing.assert_array_equal(
            np.stack(table["observation.touch"].to_pylist()), features[at]
        )
        np.testing.assert_allclose(table["timestamp"].to_pylist(), times[at])
        # the rest is unchanged
        assert table[GEL].to_pylist()[0]["bytes"].startswith(b"\x89PNG")
    info = json.loads((root / "meta" / "info.json").read_text())
    assert info["features"]["observation.touch"] == {
        "dtype": "float32",
        "shape": [16],
        "names": None,
    }
    assert main(list(map(str, words))) == 2 and "choose another name" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("cameras", "names"),
    [
        (["observation.left.tactile", "observation.right.tactile"], ["left", "right"]),
        ([GEL, VIDEO], ["gel", "tactile_film"]),
        (["a.left.gel", "a.left.gel.back"], ["a.left.gel", "a.left.gel.back"]),
        (["gel_left", "gel_right"], ["gel_left", "gel_right"]),
        ([GEL], [GEL]),
    ],
)
def test_the_columns_of_cameras_are_called_by_what_distinguishes_them(cameras, names):
    assert lerobot.camera_names(cameras) == names


def test_columns_of_two_cameras_are_written_with_their_statistics_or_not_at_all(root, monkeypatch):
    def contents():
        return {path: path.read_bytes() for path in root.rglob("*") if path.is_file()}

    (root / "meta" / "stats.json").write_text(json.dumps({"observation.force": {"mean": [0.5]}}))
    values = np.random.default_rng(0).normal(size=(2, 9, 3)).astype("f4")
    before = contents()
    numbers = np.arange(9)[::-1] + 3
    columns = {
        f"touch.{name}": (x, numbers) for name, x in zip(("left", "right"), values, strict=True)
    }
    refused(
        "no frame of index 12",
        lerobot.write_features,
        root,
        columns | {"touch.other": (values[0], numbers + 1)},
    )
    write = pa.parquet.write_table
    calls = []

    def full(table, path):
        calls.append(path)
        if len(calls) > 1:
            raise OSError(28, "No space left on device")
        write(table, path)

    with monkeypatch.context() as changed, pytest.raises(OSError, match="No space left"):
        changed.setattr(pa.parquet, "write_table", full)
        lerobot.write_features(root, columns)
    assert contents() == before
    lerobot.write_features(root, columns)
    stats = json.loads((root / "meta" / "stats.json").read_text())
    assert stats.pop("observation.force") == {"mean": [0.5]} and stats.keys() == columns.keys()
    tables = [pa.parquet.read_table(path) for path in sorted((root / "data").rglob("*.parquet"))]
    for name, (x, _) in columns.items():
        wanted = {
            "min": x.min(0),
            "max": x.max(0),
            "mean": x.mean(0),
            "std": x.std(0),
            "q50": np.median(x, 0),
        }
        for key, value in (wanted | {"count": 9}).items():
            np.testing.assert_allclose(stats[name][key], np.atleast_1d(value), atol=1e-6)
        assert {"q01", "q10", "q90", "q99"} < stats[name].keys()
        written = np.concatenate([np.stack(table[name].to_pylist()) for table in tables])
        np.testing.assert_array_equal(written, np.concatenate([np.full((3, 3), np.nan), x[::-1]]))


def test_what_is_not_a_data_set_of_this_version_is_one_sentence(root, tmp_path):
    refused(f"choose with --keys from {GEL}", rows_of, root, keys=("observation.images.none",))
    refused("no feature effort", rows_of, root, keys=(GEL,), values=("effort",))
    video = root / "videos" / VIDEO / "chunk-000" / "file-001.mp4"
    video.write_bytes(video.read_bytes()[:50])
    refused("download it again", rows_of, root, export=True)
    info = json.loads((root / "meta" / "info.json").read_text())
    (root / "meta" / "info.json").write_text(json.dumps(info | {"codebase_version": "v2.1"}))
    refused(r"v2\.1.*convert it to v3", rows_of, root)


def edit(root, change):
    """Change the rows of each Parquet file of data, by a function of the row and its number in the
    data set.
    """
    for path in sorted((root / "data").glob("*/*.parquet")):
        rows = pa.parquet.read_table(path).to_pylist()
        pa.parquet.write_table(
            pa.Table.from_pylist([row | change(row["index"]) for row in rows]), path
        )


@pytest.mark.parametrize(
    ("value", "labels"),
    [
        (
            lambda n: [[float(n + i + j) for j in range(3)] for i in range(2)],
            {f"f_{i}_{j}": [n + i + j for n in range(12)] for i in range(2) for j in range(3)},
        ),
        (
            lambda n: None if n < 2 else [float(n), 2.0],
            {"f_0": [None, None, *range(2, 12)], "f_1": [None, None, *[2.0] * 10]},
        ),
        (
            lambda n: [float(n)] * (1 + n % 2),
            {"f_0": [*range(12)], "f_1": [n if n % 2 else None for n in range(12)]},
        ),
        (lambda n: "soft" if n % 2 else None, {"f": [None, "soft"] * 6}),
        (lambda n: None, {}),
    ],
)
def test_every_value_that_is_asked_for_is_a_label_or_reported(root, value, labels):
    info = json.loads((root / "meta/info.json").read_text())
    info["features"]["f"] = {"dtype": "float32", "shape": [1]}
    (root / "meta/info.json").write_text(json.dumps(info))
    edit(root, lambda number: {"f": value(number)})
    report = index(
        "lerobot", root, options=IndexOptions(sensor="digit", keys=(GEL,), values=("f",))
    )
    table = report.manifest.table
    found = {
        name: table[name].to_pylist() for name in table.column_names if name.startswith("label.f")
    }
    assert found == {f"label.{name}": values for name, values in labels.items()}
    assert any("no row has a value of label.f" in note for note in report.notes) == (not labels)
    assert any("not read: observation.force" in note for note in report.notes)


@pytest.mark.parametrize(
    ("splits", "expected"),
    [
        ({"train": "0:1", "validation": "1:2", "test": "2:3"}, ["train", "val", "test"]),
        ({"train": "0", "test": "1:2"}, ["train", "test", "unused"]),
        ({"train": "0:2", "extra": "2:3"}, ["train", "train", "unused"]),
        ({"train": "0:3"}, None),
    ],
)
def test_splits_that_the_data_set_states_are_used(root, splits, expected):
    info = json.loads((root / "meta/info.json").read_text()) | {"splits": splits}
    (root / "meta/info.json").write_text(json.dumps(info))
    report = index(
        "lerobot", root, options=IndexOptions(sensor="digit", keys=(GEL,), val=0.0, test=1.0)
    )
    found = dict(
        zip(
            *(report.manifest.table[name].to_pylist() for name in ("episode", "split")), strict=True
        )
    )
    assert found == dict(enumerate(expected or ["test"] * 3))
    assert any("meta/info.json" in note for note in report.notes)
    (root / "meta/info.json").write_text(
        json.dumps(info | {"splits": {"train": "0:2", "test": "1:3"}})
    )
    refused(
        "episode 1 is in two splits",
        index,
        "lerobot",
        root,
        options=IndexOptions(sensor="digit", keys=(GEL,)),
    )
