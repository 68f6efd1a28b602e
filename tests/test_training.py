import fcntl
import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from runs import arrays_of, read_metrics, read_rows, run_config, saved_steps, train, write_manifest
from weights_world import save_clip

from anytouch_jax import doors
from anytouch_jax.config import SENSORS, from_json
from anytouch_jax.data import tokenizer as texts
from anytouch_jax.data.loading.loader import Loader
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.errors import UserError
from anytouch_jax.nn.functional import build
from anytouch_jax.train.mesh import make_mesh
from anytouch_jax.training.start import resolve
from anytouch_jax.weights import checkpoint
from anytouch_jax.weights.load import load_model
from anytouch_jax.weights.tree import flatten

TESTS = Path(__file__).parent
ALONE = """
import sys
from pathlib import Path
import numpy as np
from runs import arrays_of, train
from test_training import clips_only, run_config
world, stage, run, stop = sys.argv[1:]
result = train(clips_only(run_config(Path(world), int(stage))), Path(run), stop_after=int(stop))
np.savez(f"{run}.npz", **arrays_of(result))
print(result.resumed, result.step)
"""


@pytest.fixture(scope="session")
def straight(tmp_path_factory, world):
    """Stage 1, four steps at once: (run folder, result)."""
    run = tmp_path_factory.mktemp("straight") / "run"
    return run, train(run_config(world), run)


def clips_only(config):
    """Stage 2 on clips alone: one program instead of two."""
    return replace(config, data=replace(config.data, clip_fraction=1.0))


@pytest.fixture(scope="session")
def aligned(tmp_path_factory, world, straight):
    """Stage 2 on clips from that stage 1, four steps at once: (run folder, result, log)."""
    run = tmp_path_factory.mktemp("aligned") / "run"
    log = []
    return run, train(clips_only(run_config(world, 2)), run, log, init=straight[0]), log


def assert_equal_results(first, second):
    """Two runs ended with the same arrays, to the bit, the optimiser's too."""
    assert_equal_arrays(arrays_of(first), arrays_of(second))


def assert_equal_arrays(wanted, arrays):
    assert arrays.keys() == wanted.keys() and any(
        name.startswith("opt_state/mu") for name in arrays
    )
    for name, array in wanted.items():
        np.testing.assert_array_equal(arrays[name], array, err_msg=name)


def test_a_run_folder(straight, world):
    run, result = straight
    assert (result.step, result.traces) == (4, 2)  # stills and clips
    asked = run_config(world)
    assert from_json((run / "config.json").read_text()) == replace(
        asked, optim=replace(asked.optim, warmup=1)
    )
    lines = read_metrics(run)
    assert [line["step"] for line in lines] == [0, 1, 2, 3]
    assert ["next_frame" in line for line in lines] == [False, True, False, True]
    assert [line["p_u"] for line in lines] == [0.0, 0.1875, 0.375, 0.5625]
    assert all(line["loss"] > 0 and line["skipped"] == 0 and line["samples"] == 8 for line in lines)
    metadata = checkpoint.read_metadata(run)
    assert metadata["sensors"] == list(SENSORS) and metadata["source"] == {
        "init": None,
        "clip": None,
    }
    assert (
        metadata["preprocessing"]["touch"]["size"] == 28
        and metadata["preprocessing"]["touch"]["channels"] == "RGB"
    )


def test_a_start_is_resolved_before_anything_is_written(straight, world, tmp_path):
    """The record has all that decides a run: its vocabulary, its warm-up, its first parameters."""
    config = clips_only(run_config(world, 2))
    options = {"init": straight[0], "clip": None, "mesh": make_mesh(), "log": lambda _: None}
    start = resolve(config, tmp_path / "r", **options)
    assert not (tmp_path / "r").exists() and not start.resumes
    assert start.config.model.text.vocab == start.tokenizer.vocab_size < 2048
    assert start.config.optim.warmup == 1 and config.optim.warmup is None
    assert start.metadata["source"] == {"init": str(straight[0]), "clip": None}
    learned = load_model(straight[0]).params
    for name, array in parts(learned, "touch").items():
        np.testing.assert_array_equal(parts(start.params, "touch")[name], array, err_msg=name)
    again = resolve(run_config(world), straight[0], **options | {"init": None})
    assert again.resumes and again.tokenizer is None
    assert any(
        "is not read" in note
        for note in resolve(
            run_config(world), straight[0], **options | {"init": tmp_path / "other"}
        ).notes
    )


def test_a_resumed_run_equals_one_run_bit_for_bit(straight, world, tmp_path):
    run, result = straight
    log = []
    config = replace(run_config(world), run=replace(run_config(world).run, figure_every=4))
    first = train(config, tmp_path / "r", stop_after=2)
    assert (first.step, saved_steps(tmp_path / "r")) == (2, [2])
    second = train(config, tmp_path / "r", log)
    assert second.resumed == 2 and "continuing from the checkpoint of step 2" in log
    assert_equal_results(result, second)
    assert read_metrics(tmp_path / "r") == read_metrics(run)
    # at the end of each part
    figures = sorted((tmp_path / "r" / "figures").iterdir())
    assert [figure.name for figure in figures] == [
        "reconstruction_000002.png",
        "reconstruction_000004.png",
    ]
    assert all(figure.stat().st_size > 1000 for figure in figures)
    assert train(config, tmp_path / "r", log).step == 4 and "nothing to do" in log[-1]


@pytest.mark.slow
@pytest.mark.parametrize("stage", [1, 2])
def test_two_steps_and_two_more_are_bit_for_bit_four_as_users_run_them(world, tmp_path, stage):
    """Each part is its own process, on one device and with all of XLA's optimisations, unlike this
    process.
    """
    settings = {
        key: value for key, value in os.environ.items() if not key.startswith(("JAX_", "XLA_"))
    }
    settings["PYTHONPATH"] = os.pathsep.join(
        str(p) for p in (TESTS.parent / "src", TESTS, TESTS / "support")
    )

    def part(name, stop):
        command = [
            sys.executable,
            "-c",
            ALONE,
            str(world),
            str(stage),
            str(tmp_path / name),
            str(stop),
        ]
        done = subprocess.run(command, capture_output=True, text=True, env=settings, timeout=900)
        assert done.returncode == 0, done.stderr[-2000:]
        return done.stdout.split()

    assert [part("whole", 4), part("parts", 2), part("parts", 4)] == [
        ["0", "4"],
        ["0", "2"],
        ["2", "4"],
    ]
    whole, parts_ = (dict(np.load(tmp_path / f"{name}.npz")) for name in ("whole", "parts"))
    assert_equal_arrays(whole, parts_)
    assert read_metrics(tmp_path / "parts") == read_metrics(tmp_path / "whole")


def refused(config, run, **options):
    """Return the one sentence of a UserError."""
    with pytest.raises(UserError) as error:
        train(config, run, **options)
    message = str(error.value)
    assert "\n" not in message
    return message


def test_another_preset_in_the_same_folder_is_refused(straight, world):
    run, _ = straight
    before = (run / "config.json").read_bytes(), saved_steps(run)
    message = refused(run_config(world, model={"embed": 16}), run)
    assert "model.embed was 12 and is now 16" in message and str(run) in message
    assert "stage" in refused(run_config(world, 2), run)
    assert ((run / "config.json").read_bytes(), saved_steps(run)) == before


def parts(params, *names):
    return flatten({name: params[name] for name in names})


def test_stage_two_starts_from_stage_one_and_learns(straight, aligned, world, tmp_path):
    run, result, log = aligned
    assert result.traces == 1 and not any("without --init" in line for line in log)
    vocabulary = texts.load_tokenizer(run / "tokenizer.json").vocab_size
    assert from_json((run / "config.json").read_text()).model.text.vocab == vocabulary < 2048
    assert result.params["text"]["token"].shape == (vocabulary, 16)
    lines = read_metrics(run)
    assert [line["step"] for line in lines] == [0, 1, 2, 3]
    for line in lines:
        assert line["align"] > 0 and line["match"] > 0 and "reconstruction" not in line
        assert line["touch_text_pairs"] > 0 and line["touch_vision_pairs"] > 0
        assert line["loss"] == pytest.approx(line["align"] + 0.1 * line["match"], rel=1e-5)
    assert checkpoint.read_metadata(run)["source"] == {"init": str(straight[0]), "clip": None}


def test_stage_two_resumes_bit_for_bit_without_its_stage_one(straight, aligned, world, tmp_path):
    config = clips_only(run_config(world, 2))
    log = []
    init = shutil.copytree(straight[0], tmp_path / "stage1")
    run = tmp_path / "r"
    first = train(config, run, log, init=init, stop_after=1)
    # the learning rate of step 0 is 0: what stage 1 learned is still whole
    before = parts(load_model(init).params, "touch", "decoder")
    for name, array in parts(first.params, "touch", "decoder").items():
        np.testing.assert_array_equal(array, before[name], err_msg=name)
    tokenizer = (run / "tokenizer.json").read_bytes()
    # a resumed run does not need it, whether or not it is named
    shutil.rmtree(init)
    assert train(config, run, log, init=init, stop_after=1).step == 1
    assert not any("is not read" in line for line in log)
    assert train(config, run, log, init=straight[0], clip="other.bin", stop_after=1).step == 1
    ignored = [line for line in log if line.endswith("is not read")]
    assert len(ignored) == 2 and str(init) in ignored[0] and "other.bin" in ignored[1]
    last = train(config, run, log)
    assert (last.resumed, last.step, last.traces) == (1, 4, 1)
    assert_equal_results(aligned[1], last)
    assert (run / "tokenizer.json").read_bytes() == tokenizer and read_metrics(run) == read_metrics(
        aligned[0]
    )
    learned = ("touch", "image", "text", "matcher", "logit_scale")
    after = parts(last.params, *learned)
    assert not [
        name
        for name, array in parts(first.params, *learned).items()
        if np.array_equal(array, after[name])
    ]


def test_stage_two_of_the_release(straight, world, tmp_path):
    run, _ = straight
    config = clips_only(run_config(world, 2, "release"))
    result = train(config, tmp_path / "r", init=run)
    lines = read_metrics(tmp_path / "r")
    kinds = {
        ("align" in line, "match" in line, "reconstruction" in line, "next_frame" in line)
        for line in lines
    }
    # never both in a step
    assert kinds == {(True, False, True, True), (False, True, False, False)}
    assert {line["samples"] for line in lines} == {8, 4} and result.traces == 2
    for line in lines:
        sum_ = line.get("align", 0) + line.get("reconstruction", 0) + line.get("next_frame", 0)
        assert line["loss"] == pytest.approx(sum_ + 0.1 * line.get("match", 0), rel=1e-5)


def clip_folder(folder, config):
    """The weights and the tokenizer of a CLIP download, of the smallest towers."""
    tokenizer = texts.train_tokenizer(["a round thing", "an edge", "smooth and hard"], 300)
    tokenizer.save(folder)
    model = replace(config.model, text=replace(config.model.text, vocab=tokenizer.vocab_size))
    params = build(model).init(jax.random.key(9))
    save_clip(folder, model, params)
    return replace(config, model=model), params


def test_pretrained_towers_keep_the_text_tower_and_adapt_the_image_tower_by_lora(
    straight, world, tmp_path
):
    config, clip = clip_folder(
        tmp_path / "clip", clips_only(run_config(world, 2, towers="pretrained", steps=4))
    )
    result = train(config, tmp_path / "r", init=straight[0], clip=tmp_path / "clip", stop_after=3)
    assert (tmp_path / "r" / "tokenizer.json").exists()
    # frozen, and CLIP's own
    for name, array in parts(clip, "image", "text").items():
        np.testing.assert_array_equal(
            parts(result.params, "image", "text")[name], array, err_msg=name
        )
    lora = parts(result.params, "lora")
    # b starts at zero, so it has learned
    assert all(np.any(np.asarray(array)) for array in lora.values())
    assert all(line["align"] > 0 for line in read_metrics(tmp_path / "r"))
    # without CLIP's weights
    assert train(config, tmp_path / "r").resumed == 3
    assert "model.bin" in refused(
        config, tmp_path / "s", init=straight[0], clip=tmp_path / "clip" / "model.bin"
    )


def test_wrong_starts_are_one_sentence(straight, world, tmp_path):
    stage2 = run_config(world, 2)
    pretrained = run_config(world, 2, towers="pretrained")
    (tmp_path / "empty").mkdir()
    for init in ("gone", "empty"):
        assert str(tmp_path / init) in refused(stage2, tmp_path / "a", init=tmp_path / init)
    other = run_config(world, 2, model={"embed": 16})
    assert "--model.embed 12" in refused(other, tmp_path / "a", init=straight[0])
    assert "--clip-weights" in refused(pretrained, tmp_path / "a")
    assert "tokenizer" in refused(pretrained, tmp_path / "a", clip=tmp_path / "empty")
    texts.train_tokenizer(["a"], 300).save(tmp_path / "empty")
    assert "no weights" in refused(pretrained, tmp_path / "a", clip=tmp_path / "empty")
    assert not (tmp_path / "a").exists()


def test_a_run_without_its_config_resumes_from_its_checkpoint(straight, world, tmp_path):
    shutil.copytree(straight[0], tmp_path / "r")
    (tmp_path / "r" / "config.json").unlink()
    assert "run.seed was 0 and is now 1" in refused(run_config(world, seed=1), tmp_path / "r")
    assert train(run_config(world), tmp_path / "r").step == 4
    assert (tmp_path / "r" / "config.json").read_text() == (straight[0] / "config.json").read_text()


def test_settings_without_effect_are_one_sentence(world, tmp_path):
    for stage, model, objective, words in (
        (1, {"dtype": "float64"}, {}, "needs JAX_ENABLE_X64=1"),
        (2, {"match_head": "linear"}, {}, "--recipe release"),
    ):
        config = run_config(world, stage, model=model)
        config = replace(config, objective=replace(config.objective, **objective))
        assert words in refused(config, tmp_path / "r") and not (tmp_path / "r").exists()
    jax.config.update("jax_enable_x64", True)
    try:
        assert "unset it, or add --model.dtype float64" in refused(
            run_config(world), tmp_path / "r"
        )
    finally:
        jax.config.update("jax_enable_x64", False)
    config = run_config(world, 2)
    config = replace(config, optim=replace(config.optim, accumulate=2))
    assert "--optim.accumulate must be 1 in stage 2" in refused(config, tmp_path / "r")
    both = refused(run_config(world), tmp_path / "r", init="a.pth", clip="b.safetensors")
    assert "--init and --clip-weights" in both and not (tmp_path / "r").exists()


def test_two_processes_never_train_one_run(straight, world, tmp_path):
    run = tmp_path / "r"
    for started in (False, True):
        run.mkdir(exist_ok=True)
        with (run / ".lock").open("ab") as held:
            # as another process holds it, from before its first checkpoint
            fcntl.flock(held, fcntl.LOCK_EX)
            before = sorted(path.name for path in run.iterdir())
            assert f"another process trains in {run}" in refused(
                clips_only(run_config(world, 2)), run, init=straight[0]
            )
            # not even a tokenizer
            assert sorted(path.name for path in run.iterdir()) == before
        assert (
            started
            or train(clips_only(run_config(world, 2)), run, init=straight[0], stop_after=1).step
            == 1
        )


def test_warm_up_is_an_epoch_where_the_run_is_long(world, tmp_path):
    epoch = Loader(manifests.read(world), run_config(world)).steps_per_epoch
    for steps, wanted in ((20 * epoch * 3, epoch), (20 * 2, min(epoch, 2))):
        run = tmp_path / str(steps)
        train(run_config(world, steps=steps), run, stop_after=0)
        assert from_json((run / "config.json").read_text()).optim.warmup == wanted
        # and goes on by the same command
        train(run_config(world, steps=steps), run, stop_after=0)


def test_a_run_does_not_resume_on_other_rows(world, tmp_path):
    rows = [list(row.values()) for row in read_rows(world)]
    file = world.parent / "grown.csv"
    write_manifest(file, rows[:-1])
    train(run_config(file), tmp_path / "r", stop_after=1)
    write_manifest(file, rows)
    message = refused(run_config(file), tmp_path / "r")
    assert "have changed since" in message and "--init" in message
    moved = shutil.copytree(world.parent, tmp_path / "moved")
    # the same rows and files at another place
    write_manifest(moved / "other.csv", rows[:-1])
    assert train(run_config(moved / "other.csv"), tmp_path / "r", stop_after=2).step == 2


RINGS = ("sim", "fields", "datasets", "live", "zoo", "export")
TRAINED = """
import json, sys
from pathlib import Path
from runs import run_config, train
train(run_config(Path(sys.argv[1]), steps=1), Path(sys.argv[2]))
print(json.dumps([name for name in sys.modules if name.startswith("anytouch_jax.")]))
"""


def test_a_run_on_a_manifest_loads_no_module_of_a_ring(world, tmp_path):
    paths = (TESTS.parent / "src", TESTS / "support")
    done = subprocess.run(
        [sys.executable, "-c", TRAINED, str(world), str(tmp_path / "r")],
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(map(str, paths))},
        timeout=900,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    loaded = json.loads(done.stdout.splitlines()[-1])
    assert "anytouch_jax.train.loop" in loaded
    assert [name for name in loaded if name.split(".")[1] in RINGS] == []


def test_every_source_of_batches_has_the_interface_that_training_uses():
    members = ("steps_per_epoch", "trained_sensors", "examples", "stream")
    for door in doors.BATCHES.values():
        kind = doors.enter(door)
        assert all(hasattr(kind, name) for name in (*members, "train_tokenizer"))
    assert all(hasattr(Loader, name) for name in members)
