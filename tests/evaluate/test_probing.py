import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from reader_world import fill
from task_world import row, simulated, table
from touch_world import make_touches

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.datasets.readers import IndexOptions, index
from anytouch_jax.encoder.encoder import Encoder, load_encoder
from anytouch_jax.encoder.linear_head import load_head
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import feature_cache
from anytouch_jax.evaluate.feature_cache import FeatureSource, FeatureStore
from anytouch_jax.evaluate.probing import probe_benchmark, probe_label, probe_table, probe_tasks
from anytouch_jax.evaluate.tasks import BENCHMARKS, TASKS, Task, label_task, select

WORLD = simulated()
MANY = simulated(objects=60, each=4)  # enough groups for intervals that mean something


def planted(values: Any) -> FeatureStore:
    """Features that are `values(rows)` (n, d)."""
    return FeatureStore(lambda rows, frames: np.asarray(values(rows), np.float32))


def labelled_features(world: Manifest, task: str, noise: float = 0.3) -> Any:
    """Features that contain the label of the task, in a linear code under noise."""
    rows = select(world, TASKS[task])
    labels = rows.labels[:, None]
    code = labels if labels.dtype.kind == "f" else labels == np.unique(labels)
    rng = np.random.default_rng(0)
    values = np.zeros((len(world), max(12, code.shape[1])))
    values[rows.rows[:, 0], : code.shape[1]] = code
    values = values @ np.linalg.qr(rng.normal(size=values.shape[1:] * 2))[0] + noise * rng.normal(
        size=values.shape
    )
    return lambda ids: values[ids]


def noise(rows: Any) -> np.ndarray:
    return np.stack([np.random.default_rng([5, row]).normal(size=12) for row in rows])


def score_tasks(
    of: Encoder | FeatureStore,
    world: Manifest,
    names: Any,
    *,
    cache: Any = None,
    head_names: Any = ("linear",),
    protocols: Any = ("grouped",),
    **options: Any,
) -> list[dict[str, Any]]:
    """Results of one source of features: an encoder or a store."""
    if isinstance(of, FeatureStore):
        source = FeatureSource("planted", of)
    else:
        source = FeatureSource(
            "encoder", feature_cache.encoder_features(of, world, folder=cache), of
        )
    protocol = "released" if "released" in protocols else protocols[0]
    report = probe_tasks(
        [source],
        world,
        names,
        heads=head_names,
        protocol=protocol,
        controls=False,
        log=str,
        **options,
    )
    json.dumps(report, allow_nan=False)
    return report["results"]


@pytest.mark.parametrize("task", ["material", "slip", "twist", "slide", "object"])
@pytest.mark.parametrize("head", ["linear", "knn"])
def test_a_label_in_the_features_is_predicted(task, head):
    store = planted(labelled_features(MANY, task, 0.02))
    (one,) = score_tasks(store, MANY, [task], seeds=3, head_names=(head,))
    assert one["mean"] > 0.98 and one["high"] == 1.0
    assert one["chance"] < 0.75 and len(one["values"]) == 3
    assert (one["task"], one["head"], one["protocol"], one["metric"]) == (
        task,
        head,
        "grouped",
        "accuracy",
    )


@pytest.mark.parametrize("task", ["material", "twist", "slide"])
def test_noise_is_chance_within_its_interval(task):
    store = planted(noise)
    (one,) = score_tasks(store, MANY, [task], seeds=5)
    assert one["low"] <= 1 / len(one["classes"]) <= one["high"]
    assert one["high"] - one["low"] < 0.4


def test_a_number_in_the_features_is_predicted():
    store = planted(labelled_features(MANY, "force", 0.05))
    (one,) = score_tasks(store, MANY, ["force"], seeds=2)
    assert one["metric"] == "r2" and one["unit"] == "N" and one["classes"] == []
    assert 0.97 < one["low"] <= one["mean"] <= one["high"] < 1
    assert one["mae_low"] <= one["mae"] <= one["mae_high"] < 0.2 < one["chance_mae"]
    assert abs(one["chance"]) < 0.05


def test_a_split_that_shares_objects_is_not_grouped():
    """Features that know the object, not its material: a split by image rewards them, the grouped
    one does not.
    """
    shared = simulated(objects=40, each=4, shared=True)
    names = shared.codes("object")
    store = planted(lambda rows: np.eye(40)[names[rows]])
    grouped, released = score_tasks(
        store, shared, ["material"], seeds=2, protocols=("grouped", "released")
    )
    assert released["mean"] == 1.0 and grouped["mean"] < 0.5
    assert any("groups" in note for note in grouped["notes"])
    assert grouped["test"] == 40 * 4 * 2 and released["test"] == 40 * 2


def test_sensors_and_units_learned_from_and_tested():
    store = planted(labelled_features(MANY, "material", 0.02))
    (one,) = score_tasks(
        store, MANY, ["material"], seeds=1, train_sensors=["digit"], test_sensors=["duragel"]
    )
    assert one["test"] == 15 * 4
    (one,) = score_tasks(
        store, MANY, ["material"], seeds=1, train_units=["*_0"], test_units=["digit_1"]
    )
    assert one["test"] == 15 * 2 and any("*_0" in note for note in one["notes"])


def test_mistakes_are_refused():
    train = table(
        [row(path=f"{i}.png", sequence=f"{i}", label__material="ab"[i % 2]) for i in range(4)]
    )
    for word, world, task, options in (
        ("seeds", WORLD, "material", {"seeds": 0}),
        ("max_rows", WORLD, "material", {"max_rows": -3}),
        ("frames", WORLD, "material", {"frames": -1}),
        ("taste", WORLD, "taste", {}),
        ("forest", WORLD, "material", {"head_names": ("forest",)}),
        ("lucky", WORLD, "material", {"protocols": ("lucky",)}),
        ("'foam'", WORLD, Task("x", "label.material", classes=("foam",)), {}),
        ("test", train, "material", {}),
        ("gelsight", WORLD, "material", {"train_sensors": ["gelsight"]}),
        ("cam0_", WORLD, "material", {"test_units": ["cam0_*"]}),
    ):
        with pytest.raises(UserError) as error:
            score_tasks(planted(noise), world, [task], **{"seeds": 1} | options)
        assert word in str(error.value) and "\n" not in str(error.value)
    with pytest.raises(UserError, match="material"):
        score_tasks(planted(lambda rows: np.full((len(rows), 3), np.nan)), WORLD, ["material"])


# Real images and a real, untrained encoder.


@pytest.fixture(scope="module")
def touches(tmp_path_factory) -> Path:
    return make_touches(
        tmp_path_factory.mktemp("touches"), touches={"train": 8, "val": 4, "test": 4}, each=1
    )


def test_nothing_is_encoded_twice(passes, encoder, images, tmp_path):
    first = score_tasks(encoder, images, ["material", "object"], cache=tmp_path, seeds=1)
    # one pass for both tasks: they take the same rows
    assert passes == [32]
    again = score_tasks(encoder, images, ["material", "object"], cache=tmp_path, seeds=1)
    assert passes == [32] and first == again
    score_tasks(encoder, images, ["material", "force"], cache=tmp_path, seeds=1, frames=1)
    new = np.setdiff1d(select(images, TASKS["force"]).rows, select(images, TASKS["material"]).rows)
    assert passes == [32, len(new)]  # what is known is not read again
    assert len(list(tmp_path.iterdir())) == 1
    score_tasks(encoder, images, ["force"], cache=tmp_path, seeds=1)
    # clips are something else
    assert len(passes) == 3 and len(list(tmp_path.iterdir())) == 2


# The public benchmarks, on trees laid out like the originals.


def paint(root: Path) -> None:
    """Give every image under `root` bytes of its own, so that features differ."""
    rng = np.random.default_rng(0)
    for path in sorted(root.rglob("*.*g")):
        cv2.imwrite(str(path), rng.integers(0, 255, (16, 16, 3), np.uint8))


def touch_and_go(root: Path) -> None:
    lists: dict[str, list[str]] = {
        name: [] for name in ("train", "test", "train_rough", "test_rough")
    }
    for video in range(8):
        for frame in range(10, 22):
            name = f"v{video}/{frame:010d}.jpg"
            fill(root, [f"dataset/v{video}/gelsight_frame/{frame:010d}.jpg"])
            part = "test" if video % 2 and frame >= 18 else "train"
            lists[part].append(f"{name},{(3, 7)[frame % 2]}")
            rough = "train" if part == "test" else "test" if frame % 4 == 0 else "train"
            lists[f"{rough}_rough"].append(f"{name},{frame // 2 % 2}")
    for name, lines in lists.items():
        (root / f"{name}.txt").write_text("\n".join(lines) + "\n")


def feel(root: Path) -> None:
    names = [f"thing{i}" for i in range(8)]
    for name in names:
        for phase in ("before", "during", "after"):
            fill(
                root, [f"{name}/touch_{phase}/{n}_{finger}.png" for n in (0, 1) for finger in "AB"]
            )
    (root / "feel.csv").write_text("".join(f"{name},{n},{n}\n" for name in names for n in (0, 1)))
    (root / "split_3.json").write_text(json.dumps({"train": names[:6], "test": names[6:]}))


def objectfolder(root: Path) -> None:
    ids = [*range(1, 7), *range(101, 107)]
    for one in ids:
        place = "obj1.0" if one <= 100 else "obj2.0/touch"
        fill(root, [f"{place}/{one}/{n}.png" for n in range(4)])
    (root / "obj2.0").mkdir(exist_ok=True)
    (root / "obj2.0/label.json").write_text(json.dumps({str(one): one % 2 for one in ids}))
    split = {
        "train": [[str(one), n] for one in ids for n in (0, 1, 2)],
        "test": [[str(one), 3] for one in ids],
    }
    (root / "obj2.0/split.json").write_text(json.dumps(split))


MAKERS = {
    "touch_and_go": (touch_and_go, IndexOptions()),
    "feel": (feel, IndexOptions(fold=3)),
    "objectfolder": (objectfolder, IndexOptions()),
}
SIZES = {  # (train, test) of the authors' own split
    "touch_and_go_material": (80, 16),
    "touch_and_go_hardness": (80, 16),
    "touch_and_go_roughness": (76, 20),
    "feel_grasp": (12, 4),
    "objectfolder1_material": (18, 6),
    "objectfolder2_material": (18, 6),
}


@pytest.fixture(scope="module")
def trees(tmp_path_factory) -> dict[str, Path]:
    results: dict[str, Path] = {}
    for name, (make, options) in MAKERS.items():
        root = tmp_path_factory.mktemp(name)
        make(root)
        paint(root)
        results[name] = index(name, root, None, options=options).out
    return results


QUICK = ("feel_grasp", "objectfolder1_material")


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=() if name in QUICK else pytest.mark.slow) for name in BENCHMARKS],
)
def test_a_public_benchmark_is_one_call(name, trees, tiny_run, tmp_path):
    out = tmp_path / "result.json"
    data = trees[next(one for one in MAKERS if name.startswith(one))]
    report = probe_benchmark(
        [tiny_run], [data], name, seeds=1, cache=tmp_path / "cache", out=out, log=str
    )
    record = json.loads(out.read_text())
    printed = probe_table(report["results"], report["paper"])
    assert name in printed and "raw pixels" in printed and "paper" in printed
    released = {one["features"]: one for one in record["results"] if one["protocol"] == "released"}
    assert {(one["train"], one["test"]) for one in released.values()} == {SIZES[name]}
    assert len(released) == 3  # the run, a random encoder, raw pixels
    assert {one["protocol"] for one in record["results"]} == {"released", "grouped"}
    assert record["manifest"] == manifests.read(data).content_hash
    assert record["runs"][str(tiny_run)]["model"]["image_size"] == 28


def test_tasks_of_models_files_and_controls(images, tiny_run, tmp_path):
    out = tmp_path / "result.json"
    data = images.files[0]
    np.savez(
        tmp_path / "f.npz", features=noise(np.arange(len(images))), rows=np.arange(len(images))
    )
    options: dict[str, Any] = {
        "features": [tmp_path / "f.npz"],
        "heads": ("linear", "knn"),
        "test_units": ("*_1",),
    }
    report = probe_tasks(
        [tiny_run],
        [data],
        ("material", "force"),
        seeds=1,
        protocol="released",
        out=out,
        log=str,
        **options,
    )
    results = json.loads(out.read_text())["results"]
    assert {one["task"] for one in results} == {"material", "force"}
    assert {one["head"] for one in results} == {"linear", "knn"}
    names = [str(tiny_run), "random encoder", str(tmp_path / "f.npz"), "raw pixels"]
    assert list(dict.fromkeys(one["features"] for one in results)) == names
    assert {one["protocol"] for one in results} == {"grouped", "released"}
    assert " N" in probe_table(report["results"], report["paper"])
    for word, change in (
        ("--order", {"order": "shuffled"}),
        ("--aggregation", {"aggregation": "sum"}),
        ("probe", {"models": []}),
    ):
        with pytest.raises(UserError, match=word):
            probe_tasks(
                **{"models": [tiny_run], "data": [data], "tasks": ["material"], "controls": False}
                | change
            )


def test_a_task_that_cannot_be_probed_leaves_the_others(tmp_path):
    columns = WORLD.table.to_pydict()
    lines = []
    slides = zip(columns["label.slide"], columns["split"], strict=True)
    columns["label.slide"] = [None if split == "test" else one for one, split in slides]
    data = tmp_path / "m.parquet"
    features = tmp_path / "f.npz"
    manifests.write(manifests.from_columns(columns, data), data)
    np.savez(features, features=noise(np.arange(len(WORLD))), rows=np.arange(len(WORLD)))
    shared: dict[str, Any] = {
        "features": [features],
        "seeds": 1,
        "controls": False,
        "log": lines.append,
    }
    results = probe_tasks([], [data], ("material", "slide"), frames=1, **shared)
    assert {one["task"] for one in results["results"]} == {"material"} and list(
        results["left_out"]
    ) == ["slide"]
    assert any("slide" in line for line in lines)
    assert "grasp" in probe_tasks([], [data], "all", frames=1, **shared)["left_out"]
    with pytest.raises(UserError, match="slide"):
        probe_tasks([], [data], ("slide",), frames=1, **shared)


# A label column.


def test_a_label_probe_of_models_files_and_controls(touches, tiny_run, tmp_path):
    """Features of a file score as the run that made them; a saved head predicts what was scored."""
    table_ = manifests.read(touches)
    features = tmp_path / "mine.npz"
    head = tmp_path / "head.npz"
    out = tmp_path / "r.json"
    store = feature_cache.encoder_features(load_encoder(tiny_run), table_)
    values = store.get(np.arange(len(table_))[:, None], 1)
    np.savez(features, features=values, rows=np.arange(len(table_)))
    results = probe_label(
        [tiny_run], [touches], "hardness", features=[features], seeds=1, save=head, out=out, log=str
    )
    names = [str(tiny_run), "random encoder", str(features), "raw pixels"]
    assert [one.probe for one in results[:-1]] == [
        f"{name}: {kind}" for name in names for kind in ("linear", "kNN")
    ]
    assert [replace(one, probe="") for one in results[:2]] == [
        replace(one, probe="") for one in results[4:6]
    ]
    assert len(json.loads(out.read_text())) == len(results) == 9
    outcome = results[0].outcome
    rows = select(table_, label_task(table_, "hardness"))
    predicted = load_head(head)(values[rows.rows[outcome.rows, 0]])[0]
    np.testing.assert_array_equal(predicted == rows.labels[outcome.rows], outcome.correct)


@pytest.mark.parametrize(
    ("label", "options", "word"),
    [
        ("object", {}, "train"),
        ("force", {"regression": "no"}, "label.force"),
        ("split", {}, "train"),
        ("hardness", {"controls": False}, "nothing"),
        ("hardness", {"leave_out": "sensor", "sensor": "digit"}, "digit"),
        ("hardness", {"models": ["a", "b"], "save": "h.npz"}, "one"),
    ],
)
def test_a_label_that_cannot_be_probed_is_refused_before_the_work(
    touches, monkeypatch, label, options, word
):
    monkeypatch.setattr(
        feature_cache.FeatureStore, "get", lambda *_: pytest.fail("the work was begun")
    )
    with pytest.raises(UserError, match=word):
        probe_label(**{"models": [], "data": [touches], "label": label, "log": str} | options)


@pytest.mark.parametrize("option", ["group", "leave_out"])
def test_recordings_of_the_page_give_a_head(touches, tiny_run, tmp_path, option):
    """All rows are of split train: the head is fitted on all of them and calibrated by folds."""
    known = manifests.read(touches)
    rows = np.flatnonzero(known.text_column("split") == "train")
    columns = {name: known.table[name].take(rows).to_pylist() for name in known.table.column_names}
    data = touches.with_name(f"train_{option}.parquet")
    manifests.write(manifests.from_columns(columns, data), data)
    head = tmp_path / "head.npz"
    said: list[str] = []
    plain: dict[str, Any] = {"controls": False, "save": head, "log": said.append}
    (result,) = probe_label([tiny_run], [data], "hardness", **{option: "sequence"}, **plain)
    saved = load_head(head)
    assert saved.calibration is not None and saved.label == "hardness"
    assert sorted(saved.classes) == sorted(result.classes)
    assert any("fitted on all rows" in line for line in said)
    assert any("calibrated on" in line for line in said)
