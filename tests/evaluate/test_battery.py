"""The battery on features whose answer is known; its cache; two fingers; units; the public benchmarks as commands."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from battery_world import row, simulated, table
from reader_world import fill
from tiny_models import tiny_config

from anytouch_jax.cli.app import main
from anytouch_jax.data.loading.evaluation import evaluation
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.data.readers import IndexOptions, index
from anytouch_jax.encoder.encoder import Encoder, random_encoder
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import battery, battery_features, deals, heads
from anytouch_jax.evaluate.battery_features import Store, digest, encoded, ordered
from anytouch_jax.evaluate.benchmarks import BENCHMARKS, benchmark_of
from anytouch_jax.evaluate.tasks import TASKS, Task, select

WORLD = simulated()
NOBODY = Encoder(tiny_config(), {}, "planted")
MANY = simulated(objects=60, each=4)  # enough groups for intervals that mean something


def planted(monkeypatch: Any, values: Any) -> None:
    """Features that are `values(rows)` (n, d) instead of an encoder's."""
    store = Store(lambda rows, frames: np.asarray(values(rows), np.float32), {}, None)
    monkeypatch.setattr(battery, "encoded", lambda *args, **options: store)


def telling(world: Manifest, task: str, noise: float = 0.3) -> Any:
    """Features that say the label of the task, in a linear code under noise."""
    found = select(world, TASKS[task])
    code = found.labels[:, None] if found.labels.dtype.kind == "f" else found.labels[:, None] == np.unique(found.labels)
    rng = np.random.default_rng(0)
    values = np.zeros((len(world), max(12, code.shape[1])))
    values[found.rows[:, 0], : code.shape[1]] = code
    values = values @ np.linalg.qr(rng.normal(size=values.shape[1:] * 2))[0] + noise * rng.normal(size=values.shape)
    return lambda rows: values[rows]


def noise(rows: Any) -> np.ndarray:
    return np.stack([np.random.default_rng([5, row]).normal(size=12) for row in rows])


@pytest.mark.parametrize("task", ["material", "slip", "twist", "slide", "object"])
@pytest.mark.parametrize("head", ["linear", "knn"])
def test_a_label_in_the_features_is_found(monkeypatch, task, head):
    planted(monkeypatch, telling(MANY, task, 0.02))
    (one,) = battery.run(NOBODY, MANY, [task], seeds=3, head_names=(head,))
    assert one["mean"] > 0.98 and one["high"] == 1.0
    assert one["chance"] < 0.75 and len(one["values"]) == 3
    assert (one["task"], one["head"], one["protocol"], one["metric"]) == (task, head, "honest", "accuracy")
    json.dumps(one, allow_nan=False)


@pytest.mark.parametrize("task", ["material", "twist", "slide"])
def test_noise_is_chance_within_its_interval(monkeypatch, task):
    planted(monkeypatch, noise)
    (one,) = battery.run(NOBODY, MANY, [task], seeds=5)
    assert one["low"] <= 1 / len(one["classes"]) <= one["high"]
    assert one["high"] - one["low"] < 0.4


def test_the_optimism_of_the_published_protocol_shows_on_noise(monkeypatch):
    planted(monkeypatch, noise)
    recipe = heads.Recipe(epochs=30, batch=32, rate=0.03)
    found = battery.run(NOBODY, MANY, ["material", "twist"], seeds=5, protocols=("published", "honest"),
                        head_names=("linear", "knn", "gradient"), recipe=recipe)  # fmt: skip
    scores = {(one["task"], one["head"], one["protocol"]): one["mean"] for one in found}
    gains = [scores[t, h, "published"] - scores[t, h, "honest"] for t, h, p in scores if p == "honest"]
    assert np.mean(gains) > 0.02
    assert min(scores[t, "gradient", "published"] - scores[t, "gradient", "honest"] for t in ("material", "twist")) > 0


def test_a_number_in_the_features_is_found(monkeypatch):
    planted(monkeypatch, telling(MANY, "force", 0.05))
    (one,) = battery.run(NOBODY, MANY, ["force"], seeds=2)
    assert one["metric"] == "r2" and one["unit"] == "N" and one["classes"] == []
    assert 0.97 < one["low"] <= one["mean"] <= one["high"] < 1
    assert one["mae_low"] <= one["mae"] <= one["mae_high"] < 0.2 < one["chance_mae"]
    assert abs(one["chance"]) < 0.05


def test_a_number_that_is_not_there_has_no_r2(monkeypatch):
    planted(monkeypatch, noise)
    (one,) = battery.run(NOBODY, MANY, ["force"], seeds=2)
    assert one["mean"] < 0.05 and one["mae"] == pytest.approx(one["chance_mae"], rel=0.1)


def test_objects_never_trained_on_are_told_apart_by_other_touches(monkeypatch):
    planted(monkeypatch, telling(MANY, "object", 0.01))
    (one,) = battery.run(NOBODY, MANY, ["object"], seeds=2)
    assert one["test"] == 15 * 4 * 2 and one["groups"] == 60  # objects of the test split, both sensors; touches
    assert len(one["classes"]) == 15
    assert any("no class of test is in train" in note for note in one["notes"])


def test_a_split_that_shares_objects_is_not_honest(monkeypatch):
    """Features that know the object, not its material: a split by picture rewards them, the honest one does not."""
    shared = simulated(objects=40, each=4, shared=True)
    names = shared.codes("object")
    planted(monkeypatch, lambda rows: np.eye(40)[names[rows]])
    found = battery.run(NOBODY, shared, ["material"], seeds=2, protocols=("honest", "published"))
    honest, published = found
    assert published["mean"] == 1.0 and honest["mean"] < 0.5
    assert any("groups are in train and test" in note for note in honest["notes"])
    assert honest["test"] == 40 * 4 * 2 and published["test"] == 40 * 2


def test_sensors_and_units_learned_from_and_tested(monkeypatch):
    codes, mark = MANY.codes("sensor"), telling(MANY, "material", 0.02)
    planted(monkeypatch, lambda rows: np.concatenate([mark(rows), codes[rows][:, None]], 1))
    seen: list[Any] = []
    fit = heads.fit
    monkeypatch.setattr(heads, "fit", lambda *given: seen.append(given[1]) or fit(*given))
    (one,) = battery.run(NOBODY, MANY, ["material"], seeds=1, train_sensors=["digit"], test_sensors=["duragel"])
    (problem,) = seen
    assert set(problem.x[:, -1]) | set(problem.val[:, -1]) != set(problem.test[:, -1])
    assert len(set(problem.x[:, -1])) == len(set(problem.test[:, -1])) == 1
    assert one["test"] == 15 * 4
    (one,) = battery.run(NOBODY, MANY, ["material"], seeds=1, train_units=["*_0"], test_units=["digit_1"])
    assert one["test"] == 15 * 2
    assert one["notes"] == ["train units *_0", "test units digit_1"]
    with pytest.raises(UserError, match="no row has the sensor 'gelsight'; there are digit, duragel"):
        battery.run(NOBODY, MANY, ["material"], train_sensors=["gelsight"])
    with pytest.raises(UserError, match="no row has the unit 'cam0_"):
        battery.run(NOBODY, MANY, ["material"], test_units=["cam0_*"])


def test_two_fingers_are_joined_row_by_row(monkeypatch):
    """Success is the exclusive or of what the fingers feel: only the right pair in the right order can tell."""
    rng, rows, felt = np.random.default_rng(0), [], []
    for grasp in range(200):
        a, b = rng.integers(2, size=2)
        for finger, bit in rng.permutation([["A", a], ["B", b]]):
            felt.append((finger == "B", int(bit)))
            rows.append(row(path=f"{len(rows)}.png", sequence=f"g{grasp}/during/{finger}", unit=str(finger),
                            split=("train", "test")[grasp % 2], object=f"o{grasp}", touch=f"g{grasp}",
                            label__success=int(b)))  # fmt: skip
    # A finger says its own bit in a place of its own: features (bit, is B); success is the bit of finger B.
    planted(monkeypatch, lambda rows: np.array([[felt[one][1], felt[one][0]] for one in rows], float))
    (one,) = battery.run(NOBODY, table(rows), ["grasp"], seeds=1)
    assert one["mean"] == 1.0 and one["train"] == 80 and one["test"] == 100
    planted(monkeypatch, lambda rows: np.array([[felt[one][1] * (not felt[one][0]), 0] for one in rows], float))
    (blind,) = battery.run(NOBODY, table(rows), ["grasp"], seeds=1)
    assert blind["mean"] < 0.7


def test_max_rows_is_a_fixed_chance(monkeypatch):
    planted(monkeypatch, noise)
    first, again = (battery.run(NOBODY, MANY, ["material"], seeds=1, max_rows=200)[0] for _ in range(2))
    assert first == again and 100 < first["train"] + first["test"] <= 200


def test_what_cannot_be_probed_is_one_sentence(monkeypatch):
    planted(monkeypatch, noise)
    with pytest.raises(UserError, match="seeds must be at least 1"):
        battery.run(NOBODY, WORLD, ["material"], seeds=0)
    with pytest.raises(UserError, match="no task 'taste'"):
        battery.run(NOBODY, WORLD, ["taste"])
    single = Task("x", "label.material", classes=("foam",))
    with pytest.raises(UserError, match="the label is 'foam' on every row"):
        battery.run(NOBODY, WORLD, [single])
    train = table([row(path=f"{i}.png", sequence=f"{i}", label__material="ab"[i % 2]) for i in range(4)])
    with pytest.raises(UserError, match="no row is left to test"):
        battery.run(NOBODY, train, ["material"])


# Real pictures and a real, untrained encoder.


@pytest.fixture(scope="module")
def pictures(tmp_path_factory) -> Manifest:
    """A small world on disk: brighter is harder pressed, with backgrounds."""
    folder = tmp_path_factory.mktemp("pictures")
    world = simulated(objects=8, each=2, frames=4)
    rng, columns = np.random.default_rng(0), world.table.to_pydict()
    columns["background_path"] = ["ground.png"] * len(world)
    cv2.imwrite(str(folder / "ground.png"), np.full((32, 32, 3), 40, np.uint8))
    for name, force in zip(columns["path"], columns["label.force"], strict=True):
        image = 40 + 30 * force + rng.integers(0, 5, (32, 32, 3))
        cv2.imwrite(str(folder / name), image.clip(0, 255).astype(np.uint8))
    file = folder / "manifest.parquet"
    manifests.write(manifests.from_columns(columns, file), file)
    return manifests.read(file)


@pytest.fixture(scope="module")
def encoder(compiled_once) -> Encoder:
    return random_encoder(tiny_config())


def counted(monkeypatch) -> list[int]:
    """Rows that are read, by every pass over a manifest."""
    passes: list[int] = []

    def counting(table, rows, *args, **options):
        passes.append(len(rows))
        return evaluation(table, rows, *args, **options)

    monkeypatch.setattr(battery_features, "evaluation", counting)
    return passes


def test_nothing_is_encoded_twice(monkeypatch, encoder, pictures, tmp_path):
    passes = counted(monkeypatch)
    first = battery.run(encoder, pictures, ["material", "object"], cache=tmp_path, seeds=1)
    assert passes == [32]  # one pass for both tasks: they take the same rows
    again = battery.run(encoder, pictures, ["material", "object"], cache=tmp_path, seeds=1)
    assert passes == [32] and first == again
    battery.run(encoder, pictures, ["material", "force"], cache=tmp_path, seeds=1, frames=1)
    new = np.setdiff1d(select(pictures, TASKS["force"]).rows, select(pictures, TASKS["material"]).rows)
    assert passes == [32, len(new)]  # what is known is not read again
    assert len(list(tmp_path.iterdir())) == 1
    battery.run(encoder, pictures, ["force"], cache=tmp_path, seeds=1)
    assert len(passes) == 3 and len(list(tmp_path.iterdir())) == 2  # clips are something else


def test_the_cache_goes_by_content(monkeypatch, encoder, pictures, tmp_path):
    plain: dict[str, Any] = {"pooling": "class", "join": "mean", "folder": tmp_path}
    store = encoded(encoder, pictures, **plain)
    files = {store.file(1), store.file(3)}
    other = random_encoder(tiny_config(), seed=1)
    assert digest(other) != digest(encoder) == digest(random_encoder(tiny_config()))
    files.add(encoded(other, pictures, **plain).file(1))
    for change in ({"pooling": "mean"}, {"join": "concat"}, {"order": "shuffled"}, {"universal": True}):
        files.add(encoded(encoder, pictures, **plain | change).file(1))
    files.add(encoded(encoder, simulated(objects=8), **plain).file(1))
    assert len(files) == 8
    copied = tmp_path / "elsewhere"
    copied.mkdir()
    for name in ["ground.png", *pictures.column("path").to_pylist()]:
        shutil.copy2(pictures.files[0].parent / name, copied / name)
    manifests.write(manifests.from_columns(pictures.table.to_pydict(), copied / "m.parquet"), copied / "m.parquet")
    moved = manifests.read(copied / "m.parquet")
    assert encoded(encoder, moved, **plain).file(1) == store.file(1)
    middle = copied / pictures.value(len(pictures) // 2 + 1, "path")
    middle.write_bytes(middle.read_bytes()[:-1] + b"x")  # of the same size
    rewritten = encoded(encoder, moved, **plain).file(1)
    assert rewritten != store.file(1)
    (copied / pictures.value(0, "path")).write_bytes((copied / "ground.png").read_bytes())
    assert encoded(encoder, moved, **plain).file(1) != rewritten  # an equal table beside other pictures
    before = encoded(encoder, moved, **plain).file(1)
    cv2.imwrite(str(copied / "ground.png"), np.full((32, 32, 3), 41, np.uint8))  # another photograph of the gel
    assert encoded(encoder, moved, **plain).file(1) != before


def test_features_that_are_no_numbers_are_refused(monkeypatch):
    planted(monkeypatch, lambda rows: np.full((len(rows), 3), np.nan))
    with pytest.raises(UserError, match="task material: features are NaN"):
        battery.run(NOBODY, WORLD, ["material"])


@pytest.mark.parametrize(("name", "value"), [("seeds", 0), ("max_rows", -3), ("frames", -1)])
def test_counts_start_at_one(name, value):
    with pytest.raises(UserError, match=f"{name} must be at least 1, not {value}"):
        battery.run(NOBODY, WORLD, ["material"], **{name: value})


def test_a_sensor_that_training_never_saw_is_told(monkeypatch):
    planted(monkeypatch, noise)
    some = replace(NOBODY, seen=("digit",))  # the table of the model has it
    (found,) = battery.run(some, MANY, ["material"], seeds=1)
    assert found["notes"] == ["universal tokens for duragel"]


def test_classes_that_were_never_learned_are_told(monkeypatch):
    planted(monkeypatch, noise)
    rows = [
        row(path=f"{i}.png", sequence=f"{i}", object=f"o{i // 2}", split="train" if i < 40 else "test",
            label__material="ab"[i % 2] if i < 40 else "ac"[i % 2])
        for i in range(60)
    ]  # fmt: skip
    (found,) = battery.run(NOBODY, table(rows), ["material"], seeds=1)
    assert "10 test rows of classes that train lacks count as errors: c" in found["notes"]


def test_a_broken_cache_is_made_again(monkeypatch, encoder, pictures, tmp_path):
    rows = np.arange(4)
    whole = encoded(encoder, pictures, pooling="class", join="mean", folder=tmp_path)
    values = whole.get(rows[:, None], 1)
    whole.file(1).write_bytes(whole.file(1).read_bytes()[:200])
    passes = counted(monkeypatch)
    again = encoded(encoder, pictures, pooling="class", join="mean", folder=tmp_path)
    np.testing.assert_array_equal(again.get(rows[:, None], 1), values)
    assert passes == [4]


def test_the_order_of_frames(monkeypatch, encoder, pictures):
    clips = np.arange(24).reshape(8, 3)
    rows = np.arange(8)
    np.testing.assert_array_equal(ordered(clips, rows, "right"), clips)
    np.testing.assert_array_equal(ordered(clips, rows, "repeated"), np.repeat(clips[:, 2:], 3, 1))
    mixed = ordered(clips, rows, "shuffled")
    assert (np.sort(mixed, 1) == clips).all() and (mixed != clips).any(1).all()
    assert len({tuple(one - one.min()) for one in mixed}) > 2
    np.testing.assert_array_equal(ordered(clips[3:5], rows[3:5], "shuffled"), mixed[3:5])  # by the row's own number
    np.testing.assert_array_equal(ordered(clips[:, :1], rows, "shuffled"), clips[:, :1])
    with pytest.raises(UserError, match="unknown order 'backwards'"):
        ordered(clips, rows, "backwards")
    ends = pictures.clips(3)[:6, -1]
    stores = {
        o: encoded(encoder, pictures, pooling="class", join="mean", order=o) for o in ("right", "shuffled", "repeated")
    }
    values = {name: store.get(ends[:, None], 3) for name, store in stores.items()}
    stills = stores["right"].get(ends[:, None], 1)
    np.testing.assert_allclose(values["repeated"], stills, atol=2e-5)
    assert np.abs(values["right"] - values["shuffled"]).max() > 1e-4
    assert np.abs(values["right"] - values["repeated"]).max() > 1e-4


def test_universal_tokens_for_sensors_that_the_model_knows(encoder, pictures):
    plain: dict[str, Any] = {"pooling": "class", "join": "mean"}
    known, universal = (encoded(encoder, pictures, **plain, universal=one) for one in (False, True))
    rows = np.flatnonzero(np.array(pictures.column("sensor").to_pylist()) == "digit")[:3]
    assert np.abs(known.get(rows[:, None], 1) - universal.get(rows[:, None], 1)).max() > 1e-4


def test_raw_pixels_see_the_force_and_their_own_cache(pictures, tmp_path):
    (one,) = battery.run(None, pictures, ["force"], seeds=1, cache=tmp_path)
    assert one["mean"] > 0.9 and one["frames"] == 3
    (file,) = tmp_path.iterdir()
    stamp = file.stat().st_mtime_ns
    assert battery.run(None, pictures, ["force"], seeds=1, cache=tmp_path) == [one]
    assert file.stat().st_mtime_ns == stamp
    (still,) = battery.run(None, pictures, ["force"], seeds=1, frames=1)
    assert (still["frames"], still["test"]) == (1, one["test"])
    store = battery_features.raw(pictures)
    assert store.get(np.array([[2]]), 1).shape == (1, 2 * 2304) and store.get(np.array([[2]]), 3).shape == (1, 4 * 2304)


def test_components_of_pixels_do_not_hang_on_the_rows_that_are_tested():
    rng, train = np.random.default_rng(0), np.arange(90) < 60
    x, everything = rng.random((90, 40)).astype(np.float32), np.ones(90, bool)
    groups = np.array([f"g{row // 3}" for row in range(90)])
    rows = deals.Rows(np.arange(90) % 2, groups, train, ~train, everything, everything)
    other = np.where(train[:, None], x, 10 * x**2)
    first, second = (battery._components(pixels, rows) for pixels in (x, other))
    np.testing.assert_array_equal(first[train], second[train])
    assert first.shape == (90, 40) and np.abs(first - second)[~train].min() > 0


# The public benchmarks, on trees laid out like the originals.


def paint(root: Path) -> None:
    """Give every picture under `root` bytes of its own, so that features differ."""
    rng = np.random.default_rng(0)
    for path in sorted(root.rglob("*.*g")):
        cv2.imwrite(str(path), rng.integers(0, 255, (16, 16, 3), np.uint8))


def touch_and_go(root: Path) -> None:
    lists: dict[str, list[str]] = {name: [] for name in ("train", "test", "train_rough", "test_rough")}
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
            fill(root, [f"{name}/touch_{phase}/{n}_{finger}.png" for n in (0, 1) for finger in "AB"])
    (root / "feel.csv").write_text("".join(f"{name},{n},{n}\n" for name in names for n in (0, 1)))
    (root / "split_3.json").write_text(json.dumps({"train": names[:6], "test": names[6:]}))


def objectfolder(root: Path) -> None:
    ids = [*range(1, 7), *range(101, 107)]
    for one in ids:
        place = "obj1.0" if one <= 100 else "obj2.0/touch"
        fill(root, [f"{place}/{one}/{n}.png" for n in range(4)])
    (root / "obj2.0").mkdir(exist_ok=True)
    (root / "obj2.0/label.json").write_text(json.dumps({str(one): one % 2 for one in ids}))
    split = {"train": [[str(one), n] for one in ids for n in (0, 1, 2)], "test": [[str(one), 3] for one in ids]}
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
    found: dict[str, Path] = {}
    for name, (make, options) in MAKERS.items():
        root = tmp_path_factory.mktemp(name)
        make(root)
        paint(root)
        found[name] = index(name, root, None, options=options).out
    return found


def source_of(benchmark: str) -> str:
    return next(name for name in MAKERS if benchmark.startswith(name))


QUICK = ("feel_grasp", "objectfolder1_material")


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in QUICK else pytest.mark.slow) for name in BENCHMARKS]
)
def test_a_public_benchmark_is_one_command(name, trees, tiny_run, tmp_path, capsys):
    out = tmp_path / "result.json"
    words = ["--benchmark", name, "--run", str(tiny_run), "--data", str(trees[source_of(name)])]
    assert main(["probe", *words, "--seeds", "1", "--cache", str(tmp_path / "cache"), "--out", str(out)]) == 0
    record = json.loads(out.read_text())
    printed = capsys.readouterr().out
    assert name in printed and "raw pixels" in printed and "the paper reports" in printed
    published = {one["features"]: one for one in record["results"] if one["protocol"] == "published"}
    assert {(one["train"], one["test"]) for one in published.values()} == {SIZES[name]}
    assert len(published) == 3  # the run, a random encoder, raw pixels
    assert {one["protocol"] for one in record["results"]} == {"published", "honest"}
    assert record["manifest"] == manifests.read(trees[source_of(name)]).content_hash
    assert record["runs"][str(tiny_run)]["model"]["image_size"] == 28


@pytest.mark.parametrize("name", list(BENCHMARKS))
def test_honest_parts_videos_and_objects(name, trees):
    found = select(manifests.read(trees[source_of(name)]), benchmark_of(name).task)
    kinds = {one.split(" ")[0] for one in found.groups}
    assert kinds == ({"recording"} if "touch_and_go" in name else {"object"})


def test_the_presets_are_the_authors():
    """Released code, run_probe_*.sh; batches of two devices together."""
    told = {name: (one.pooling, one.universal, one.recipe.batch, one.recipe.rate, one.recipe.decay) for name, one
            in BENCHMARKS.items()}  # fmt: skip
    assert told == {
        "touch_and_go_material": ("class", False, 128, 2e-4, 0.05),
        "touch_and_go_roughness": ("class", False, 128, 2e-4, 0.05),
        "touch_and_go_hardness": ("class", False, 128, 2e-4, 0.05),
        "feel_grasp": ("class", False, 256, 1e-3, 0.05),
        "objectfolder1_material": ("mean", True, 128, 1e-3, 0.01),
        "objectfolder2_material": ("class", True, 256, 1e-3, 0.01),
    }
    assert {one.recipe.epochs for one in BENCHMARKS.values()} == {50}
    with pytest.raises(UserError, match="no benchmark 'mnist'; choose among touch_and_go_material"):
        benchmark_of("mnist")


def test_tasks_from_the_command_line(pictures, tiny_run, tmp_path, capsys):
    out = tmp_path / "result.json"
    data = str(pictures.files[0])
    words = ["--tasks", "material, force", "--run", str(tiny_run), "--data", data, "--seeds", "1", "--out", str(out)]
    assert main(["probe", *words, "--heads", "linear,knn", "--protocol", "published", "--test-units", "*_1"]) == 0
    results = json.loads(out.read_text())["results"]
    assert {one["task"] for one in results} == {"material", "force"}
    assert {one["head"] for one in results if one["features"] == str(tiny_run)} == {"linear", "knn"}
    assert {one["protocol"] for one in results} == {"honest", "published"}
    assert " N" in capsys.readouterr().out
    assert main(["probe", "--tasks", "material", "--benchmark", "feel_grasp", "--data", data]) == 1
    assert "not both" in capsys.readouterr().err
    assert main(["probe", "--tasks", "taste", "--data", data]) == 1
    assert "no task 'taste'" in capsys.readouterr().err


def test_a_task_that_cannot_be_probed_leaves_the_others(monkeypatch, tmp_path, capsys):
    planted(monkeypatch, noise)
    monkeypatch.setattr(battery, "raw", battery.encoded)
    columns = WORLD.table.to_pydict()
    slides = zip(columns["label.slide"], columns["split"], strict=True)
    columns["label.slide"] = [None if split == "test" else one for one, split in slides]
    data, out = tmp_path / "m.parquet", tmp_path / "r.json"
    manifests.write(manifests.from_columns(columns, data), data)
    words = ["probe", "--data", str(data), "--seeds", "1", "--out", str(out), "--tasks"]
    assert main([*words, "material,slide"]) == 0
    assert "slide: not probed (no row is left to test" in capsys.readouterr().err
    found = json.loads(out.read_text())
    assert {one["task"] for one in found["results"]} == {"material"} and list(found["left_out"]) == ["slide"]
    assert main([*words, "all"]) == 0
    told = capsys.readouterr().err
    assert "slide: not probed (no row is left" in told and "grasp: not probed (the manifest has no such label)" in told
    assert main([*words, "slide"]) == 1
    assert "task slide: no row is left to test" in capsys.readouterr().err


def test_a_task_that_is_not_there(pictures, capsys):
    assert main(["probe", "--tasks", "taste", "--data", str(pictures.files[0])]) == 1
    assert "no task 'taste'" in capsys.readouterr().err


def test_a_fit_that_does_not_converge_is_told_of(monkeypatch):
    planted(monkeypatch, telling(MANY, "material", noise=1.0))
    (one,) = battery.run(NOBODY, MANY, ["material"], seeds=2)
    assert not any("converge" in note for note in one["notes"])
    monkeypatch.setattr("anytouch_jax.evaluate.logistic.STEPS", 1)
    (one,) = battery.run(NOBODY, MANY, ["material"], seeds=2)
    assert one["notes"][-1].endswith("fits did not converge")
