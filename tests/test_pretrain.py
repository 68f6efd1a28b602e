"""Whole runs on a small world on disk: stage 1, then stage 2 from it, resumed, refused, started from other weights."""

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
from touch_world import make_touches

from anytouch_jax.cli.app import main
from anytouch_jax.config import SENSORS, from_json, to_json
from anytouch_jax.data import tokenizer as texts
from anytouch_jax.data.loading.loader import Loader
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.errors import UserError
from anytouch_jax.nn.functional import build
from anytouch_jax.weights import checkpoint, convert, safetensors
from anytouch_jax.weights.compatible import resize_position
from anytouch_jax.weights.load import load_model
from anytouch_jax.weights.tree import flatten

TESTS = Path(__file__).parent
ALONE = """
import sys
from pathlib import Path
import numpy as np
from runs import arrays_of, train
from test_pretrain import clips_only, run_config
world, stage, run, stop = sys.argv[1:]
result = train(clips_only(run_config(Path(world), int(stage))), Path(run), stop_after=int(stop))
np.savez(f"{run}.npz", **arrays_of(result))
print(result.resumed, result.step)
"""


@pytest.fixture(autouse=True)
def _compiled_once(compiled_once):
    """Most runs here share their programs."""


@pytest.fixture(scope="session")
def straight(tmp_path_factory, world, compiled_once):
    """Stage 1, four steps at once: (run folder, result)."""
    run = tmp_path_factory.mktemp("straight") / "run"
    return run, train(run_config(world), run)


def clips_only(config):
    """Stage 2 on clips alone: one program instead of two."""
    return replace(config, data=replace(config.data, clip_share=1.0))


# Stage 1 ------------------------------------------------------------------------------------------------------------


def test_a_run_folder(straight, world):
    run, result = straight
    assert (result.step, result.traces) == (4, 2)  # stills and clips
    asked = run_config(world)
    assert from_json((run / "config.json").read_text()) == replace(asked, optim=replace(asked.optim, warmup=1))
    lines = read_metrics(run)
    assert [line["step"] for line in lines] == [0, 1, 2, 3]
    assert ["next_frame" in line for line in lines] == [False, True, False, True]
    assert [line["p_u"] for line in lines] == [0.0, 0.1875, 0.375, 0.5625]
    assert all(line["loss"] > 0 and line["skipped"] == 0 and line["samples"] == 8 for line in lines)
    told = checkpoint.read_metadata(run)
    assert told["sensors"] == list(SENSORS) and told["source"] == {"init": None, "clip": None}
    assert told["preprocessing"]["touch"]["size"] == 28 and told["preprocessing"]["touch"]["channels"] == "RGB"


def test_stopping_and_going_on_is_bit_for_bit_one_run(straight, world, tmp_path):
    run, result = straight
    said = []
    config = replace(run_config(world), run=replace(run_config(world).run, figure_every=4))
    first = train(config, tmp_path / "r", stop_after=2)
    assert (first.step, saved_steps(tmp_path / "r")) == (2, [2])
    second = train(config, tmp_path / "r", said)
    assert second.resumed == 2 and "going on from the checkpoint of step 2" in said
    wanted, found = arrays_of(result), arrays_of(second)
    assert found.keys() == wanted.keys() and any(name.startswith("opt_state/mu") for name in found)
    for name, array in wanted.items():
        np.testing.assert_array_equal(found[name], array, err_msg=name)
    assert read_metrics(tmp_path / "r") == read_metrics(run)
    figures = sorted((tmp_path / "r" / "figures").iterdir())  # at the end of each part
    assert [figure.name for figure in figures] == ["reconstruction_000002.png", "reconstruction_000004.png"]
    assert all(figure.stat().st_size > 1000 for figure in figures)
    assert train(config, tmp_path / "r", said).step == 4 and "nothing to do" in said[-1]


@pytest.mark.slow
@pytest.mark.parametrize("stage", [1, 2])
def test_two_steps_and_two_more_are_bit_for_bit_four_as_users_run_them(world, tmp_path, stage):
    """On one device and with all of XLA's optimisations, unlike this process; each part is a process of its own."""
    settings = {key: value for key, value in os.environ.items() if not key.startswith(("JAX_", "XLA_"))}
    settings["PYTHONPATH"] = os.pathsep.join([str(TESTS.parent / "src"), str(TESTS), settings.get("PYTHONPATH", "")])

    def part(name, stop):
        command = [sys.executable, "-c", ALONE, str(world), str(stage), str(tmp_path / name), str(stop)]
        done = subprocess.run(command, capture_output=True, text=True, env=settings, timeout=900)
        assert done.returncode == 0, done.stderr[-2000:]
        return done.stdout.split()

    assert [part("whole", 4), part("parts", 2), part("parts", 4)] == [["0", "4"], ["0", "2"], ["2", "4"]]
    wanted, found = (dict(np.load(tmp_path / f"{name}.npz")) for name in ("whole", "parts"))
    assert found.keys() == wanted.keys() and any(name.startswith("opt_state/mu") for name in found)
    for name, array in wanted.items():
        np.testing.assert_array_equal(found[name], array, err_msg=name)
    assert read_metrics(tmp_path / "parts") == read_metrics(tmp_path / "whole")


def refused(config, run, **options):
    """The one sentence that a mistake is answered with; nothing of the run is touched."""
    with pytest.raises(UserError) as error:
        train(config, run, **options)
    message = str(error.value)
    assert "\n" not in message
    return message


def test_another_preset_in_the_same_folder_is_refused(straight, world):
    run, _ = straight
    before = (run / "config.json").read_bytes(), saved_steps(run)
    told = refused(run_config(world, model={"embed": 16}), run)
    assert "model.embed was 12 and is now 16" in told and str(run) in told
    assert "stage" in refused(run_config(world, 2), run)
    assert ((run / "config.json").read_bytes(), saved_steps(run)) == before


# Stage 2 ------------------------------------------------------------------------------------------------------------


def parts(params, *names):
    return flatten({name: params[name] for name in names})


def as_used(run, result):
    """What a run learned, the rows of sensors that it never saw served by the universal tokens."""
    loaded = load_model(run)
    assert 0 < len(loaded.trained_sensors) < len(SENSORS)
    return loaded.params


def test_stage_two_starts_from_stage_one_learns_and_goes_on(straight, world, tmp_path):
    run, stage1 = straight
    config, said = clips_only(run_config(world, 2)), []
    init = shutil.copytree(run, tmp_path / "stage1")
    first = train(config, tmp_path / "r", said, init=init, stop_after=1)
    # the learning rate of step 0 is 0: what stage 1 learned is still whole
    for name, array in parts(as_used(run, stage1), "touch", "decoder").items():
        np.testing.assert_array_equal(parts(first.params, "touch", "decoder")[name], array, err_msg=name)
    assert not any("without a stage-1 run" in line for line in said)

    tokenizer = (tmp_path / "r" / "tokenizer.json").read_bytes()
    vocabulary = texts.load_tokenizer(tmp_path / "r" / "tokenizer.json").vocab_size
    assert from_json((tmp_path / "r" / "config.json").read_text()).model.text.vocab == vocabulary < 2048
    assert first.params["text"]["token"].shape == (vocabulary, 16)

    whole = train(config, tmp_path / "whole", said, init=init)
    shutil.rmtree(init)  # what goes on needs it no more, whether or not it is named
    assert train(config, tmp_path / "r", said, init=init, stop_after=2).step == 2
    assert not any("is not read" in line for line in said)
    assert train(config, tmp_path / "r", said, init=run, clip="other.bin", stop_after=2).step == 2
    assert "--clip-weights (nothing): other.bin is not read" in "".join(said)
    assert f"was started with --init {init}: {run} is not read" in said[-1] + "".join(said)
    last = train(config, tmp_path / "r", said)
    assert (last.resumed, last.step, last.traces) == (2, 4, 1)
    wanted, found = arrays_of(whole), arrays_of(last)
    assert found.keys() == wanted.keys() and any(name.startswith("opt_state/mu") for name in found)
    for name, array in wanted.items():
        np.testing.assert_array_equal(found[name], array, err_msg=name)
    assert not any("without a stage-1 run" in line for line in said)
    assert (tmp_path / "r" / "tokenizer.json").read_bytes() == tokenizer
    lines = read_metrics(tmp_path / "r")
    assert [line["step"] for line in lines] == [0, 1, 2, 3]
    for line in lines:
        assert line["align"] > 0 and line["match"] > 0 and "reconstruction" not in line
        assert line["touch_text_pairs"] > 0 and line["touch_vision_pairs"] > 0
        assert line["loss"] == pytest.approx(line["align"] + 0.1 * line["match"], rel=1e-5)
    moved = parts(last.params, "touch", "image", "text", "matcher", "logit_scale")
    same = {n for n, a in parts(first.params, "touch", "image", "text", "matcher", "logit_scale").items()
            if np.array_equal(a, moved[n])}  # fmt: skip
    assert same == set()
    source = checkpoint.read_metadata(tmp_path / "r")["source"]
    assert source == {"init": str(init), "clip": None}


def test_the_tokenizer_made_of_the_captions_is_no_larger_than_was_asked_for(world, tmp_path):
    config = clips_only(run_config(world, 2))
    config = replace(config, model=replace(config.model, text=replace(config.model.text, vocab=262)))
    params = train(config, tmp_path / "r", stop_after=0).params
    assert params["text"]["token"].shape == (262, 16)
    assert from_json((tmp_path / "r" / "config.json").read_text()).model.text.vocab == 262


def test_stage_two_of_the_release(straight, world, tmp_path):
    run, _ = straight
    config = clips_only(run_config(world, 2, "release"))
    result = train(config, tmp_path / "r", init=run)
    lines = read_metrics(tmp_path / "r")
    kinds = {("align" in line, "match" in line, "reconstruction" in line, "next_frame" in line) for line in lines}
    assert kinds == {(True, False, True, True), (False, True, False, False)}  # never both in a step
    assert {line["samples"] for line in lines} == {8, 4} and result.traces == 2
    for line in lines:
        sum_ = line.get("align", 0) + line.get("reconstruction", 0) + line.get("next_frame", 0)
        assert line["loss"] == pytest.approx(sum_ + 0.1 * line.get("match", 0), rel=1e-5)


def clip_folder(folder, config):
    """Weights and tokenizer as CLIP's download has them, of the smallest towers."""
    tokenizer = texts.train_tokenizer(["a round thing", "an edge", "smooth and hard"], 300)
    tokenizer.save(folder)
    model = replace(config.model, text=replace(config.model.text, vocab=tokenizer.vocab_size))
    params = build(model).init(jax.random.key(9))
    plain = replace(model, lora_rank=0)
    full = convert.to_release({n: p for n, p in params.items() if n != "lora"}, plain, allow_extra=True)
    keys = convert.release_names(plain, "clip")
    safetensors.write_safetensors(folder / "model.safetensors", {key: full[key] for key in keys}, {"format": "pt"})
    return replace(config, model=model), params


def test_pretrained_towers_keep_the_text_tower_and_adapt_the_image_tower_by_lora(straight, world, tmp_path):
    config, clip = clip_folder(tmp_path / "clip", clips_only(run_config(world, 2, towers="pretrained", steps=4)))
    result = train(config, tmp_path / "r", init=straight[0], clip=tmp_path / "clip", stop_after=3)
    assert (tmp_path / "r" / "tokenizer.json").exists()
    for name, array in parts(clip, "image", "text").items():  # frozen, and CLIP's own
        np.testing.assert_array_equal(parts(result.params, "image", "text")[name], array, err_msg=name)
    lora = parts(result.params, "lora")
    assert all(np.any(np.asarray(array)) for array in lora.values())  # b starts at zero, so it has learned
    assert all(line["align"] > 0 for line in read_metrics(tmp_path / "r"))
    assert train(config, tmp_path / "r").resumed == 3  # without CLIP's weights
    assert "model.bin" in refused(config, tmp_path / "s", init=straight[0], clip=tmp_path / "clip" / "model.bin")


def test_without_stage_one_the_touch_encoder_is_clips_with_or_without_an_image_tower(world, tmp_path):
    config, clip = clip_folder(tmp_path / "clip", clips_only(run_config(world, 2, towers="pretrained")))
    config = replace(config, model=replace(config.model, image=None, lora_rank=0))
    result = train(config, tmp_path / "r", clip=tmp_path / "clip", stop_after=0)
    np.testing.assert_array_equal(result.params["touch"]["position"], clip["image"]["position"])
    np.testing.assert_array_equal(result.params["text"]["position"], clip["text"]["position"])


def test_stage_one_starts_its_touch_encoder_from_clip(world, tmp_path):
    _, clip = clip_folder(tmp_path / "clip", run_config(world, 2))
    result = train(run_config(world), tmp_path / "r", clip=tmp_path / "clip", stop_after=0)
    touch = result.params["touch"]
    np.testing.assert_array_equal(touch["position"], clip["image"]["position"])
    for frame in np.asarray(touch["patch"]["kernel"]):  # repeated, not divided (golden Q1)
        np.testing.assert_array_equal(frame, clip["image"]["patch"]["kernel"])


@pytest.mark.parametrize(
    ("file", "told"),
    [
        ("config.json", {"text_config": {"hidden_act": "quick_gelu"}, "vision_config": {"hidden_act": "quick_gelu"}}),
        ("config.json", {"model_type": "clip", "vision_config": {}}),  # HF's default
        ("open_clip_config.json", {"model_cfg": {"quick_gelu": True}}),
    ],
)
@pytest.mark.parametrize("stage", [1, 2])
def test_clip_weights_of_another_activation_are_refused(world, tmp_path, file, told, stage):
    clip_folder(tmp_path / "clip", run_config(world, 2))
    towers = "scratch" if stage == 1 else "pretrained"
    (tmp_path / "clip" / file).write_text(json.dumps(told))
    for path in (tmp_path / "clip", tmp_path / "clip" / "model.safetensors"):
        message = refused(run_config(world, stage, towers=towers), tmp_path / "r", clip=path)
        assert "model.safetensors was trained with quick_gelu" in message and "--model.activation quick_gelu" in message


def test_clip_weights_of_another_size_are_one_short_sentence(world, tmp_path):
    config, _ = clip_folder(tmp_path / "clip", run_config(world, 2, towers="pretrained"))
    stack = replace(config.model.touch, width=32)
    wide = replace(config, model=replace(config.model, touch=stack, image=stack))
    stage1 = run_config(world, model={"touch": replace(config.model.touch, depth=1), "patch": 14})
    for name, one, told in (
        ("image tower", wide, "width 32, depth 2 and patches of 7"),
        ("touch encoder", stage1, "width 16, depth 1 and patches of 14"),
    ):
        message = refused(one, tmp_path / "r", clip=tmp_path / "clip")
        assert (
            f"model.safetensors has width 16, depth 2 and patches of 7, this run's {name} {told}: --preset" in message
        )
        assert "--preset large fits ViT-L/14" in message and len(message) < 400


# Mistakes -----------------------------------------------------------------------------------------------------------


def test_wrong_starts_are_one_sentence(straight, world, tmp_path):
    run, _ = straight
    stage2 = run_config(world, 2)
    assert "no run folder or weights file" in refused(stage2, tmp_path / "a", init=tmp_path / "gone")
    (tmp_path / "empty").mkdir()
    assert str(tmp_path / "empty") in refused(stage2, tmp_path / "a", init=tmp_path / "empty")
    other = run_config(world, 2, model={"embed": 16})
    assert "this run would use 16: add --model.embed 12" in refused(other, tmp_path / "b", init=run)
    wide = replace(other.model.touch, width=32, heads=1)
    several = refused(replace(other, model=replace(other.model, touch=wide)), tmp_path / "b", init=run)
    assert several.endswith(
        f"add --model.embed 12 --model.touch.width 16 --model.touch.heads {other.model.touch.heads}"
    )
    other = run_config(world, 2, model={"activation": "quick_gelu"})
    assert "trained with gelu, this run would use quick_gelu" in refused(other, tmp_path / "b", init=run)
    other = run_config(world, 2)
    stack = replace(other.model.touch, heads=other.model.touch.heads // 2)
    other = replace(other, model=replace(other.model, touch=stack))
    assert f"this run would use {stack.heads}: add --model.touch.heads" in refused(other, tmp_path / "b", init=run)
    narrow = replace(stage2.model.touch, width=8)
    other = replace(stage2, preset="small", model=replace(stage2.model, touch=narrow))
    assert "would have preset small: add --preset tiny" in refused(other, tmp_path / "b", init=run)
    pretrained = run_config(world, 2, towers="pretrained")
    assert "--clip" in refused(pretrained, tmp_path / "c")
    assert "tokenizer" in refused(pretrained, tmp_path / "c", clip=tmp_path / "empty")
    texts.train_tokenizer(["a"], 300).save(tmp_path / "empty")
    assert "no weights" in refused(pretrained, tmp_path / "d", clip=tmp_path / "empty")
    assert not (tmp_path / "a").exists() or not saved_steps_if_any(tmp_path / "a")


def saved_steps_if_any(run):
    return saved_steps(run) if (run / "checkpoints").exists() else []


@pytest.mark.parametrize("content", [b'{"architectures": ["CLIPModel"]}', b"\xff\xfe\x00"], ids=["foreign", "binary"])
def test_a_config_that_is_not_ours_is_replaced_or_named(straight, world, tmp_path, content):
    (tmp_path / "new").mkdir()
    (tmp_path / "new" / "config.json").write_bytes(content)
    train(run_config(world), tmp_path / "new", stop_after=0)  # no run was there
    assert from_json((tmp_path / "new" / "config.json").read_text()).run.steps == 4
    shutil.copytree(straight[0], tmp_path / "begun")
    (tmp_path / "begun" / "config.json").write_bytes(content)
    told = refused(run_config(world), tmp_path / "begun")
    assert f"{tmp_path / 'begun' / 'config.json'} cannot be read" in told


def test_a_run_whose_config_is_lost_goes_on_as_its_checkpoint_says(straight, world, tmp_path):
    shutil.copytree(straight[0], tmp_path / "r")
    (tmp_path / "r" / "config.json").unlink()
    assert "run.seed was 0 and is now 1" in refused(run_config(world, seed=1), tmp_path / "r")
    assert train(run_config(world), tmp_path / "r").step == 4
    assert (tmp_path / "r" / "config.json").read_text() == (straight[0] / "config.json").read_text()


def test_settings_that_would_do_nothing_are_one_sentence(world, tmp_path):
    for stage, model, objective, told in (
        (1, {"dtype": "float64"}, {}, "needs JAX_ENABLE_X64=1"),
        (2, {}, {"force": 0.1}, "a loss of stage 1"),
        (2, {}, {"differences": 1.0}, "needs --objective.reconstruct"),
    ):
        config = run_config(world, stage, model=model)
        config = replace(config, objective=replace(config.objective, **objective))
        assert told in refused(config, tmp_path / "r") and not (tmp_path / "r").exists()
    config = run_config(world, 2)
    config = replace(config, optim=replace(config.optim, accumulate=2))
    assert "--optim.accumulate must be 1 in stage 2" in refused(config, tmp_path / "r")
    both = refused(run_config(world), tmp_path / "r", init="a.pth", clip="b.safetensors")
    assert "--init and --clip-weights" in both and not (tmp_path / "r").exists()


@pytest.mark.parametrize("form", ["run", "file"])
def test_weights_for_another_image_size_have_their_positions_resized(straight, world, tmp_path, form):
    run, result = straight
    init, before = run, as_used(run, result)
    if form == "file":
        model = from_json((run / "config.json").read_text()).model
        init = tmp_path / "w.safetensors"
        safetensors.write_safetensors(init, convert.to_release(before, model), {safetensors.MODEL_KEY: to_json(model)})
    said: list[str] = []
    params = train(run_config(world, model={"image_size": 56}), tmp_path / "r", said, init=init, stop_after=0).params
    for part in ("touch", "decoder"):
        table = np.asarray(before[part]["position"])
        rows = len(params[part]["position"])
        assert rows == 1 + 4 * (len(table) - 1)
        np.testing.assert_allclose(params[part]["position"], resize_position(table, rows), atol=1e-6)
    assert f"the positions of {init} are resized for images of 56 pixels" in said


def test_a_batch_that_the_devices_cannot_share_is_one_sentence(world, tmp_path):
    assert "4 devices" in refused(run_config(world, batch=6), tmp_path / "r")


def test_without_captions_and_photographs_stage_two_still_matches(world, tmp_path):
    """No tokenizer is needed, none is written, and no text tower is asked for anything."""
    rows = [{**row, "text": "", "image_path": ""} for row in read_rows(world)]
    columns = tuple(rows[0])
    manifest = write_manifest(world.parent / "bare.csv", [[row[c] for c in columns] for row in rows], columns)
    result = train(clips_only(run_config(manifest, 2)), tmp_path / "r", stop_after=1)
    assert not (tmp_path / "r" / "tokenizer.json").exists()
    (line,) = read_metrics(tmp_path / "r")
    assert line["match"] > 0 and line["align"] == 0 and result.step == 1


def test_touches_shown_otherwise_than_to_stage_one_are_told_of(tmp_path):
    file = make_touches(tmp_path / "touches", touches={"train": 8}, frames=4, size=28, each=2)
    train(run_config(file), tmp_path / "one", stop_after=1)
    config = clips_only(run_config(file, 2))
    other = replace(config, data=replace(config.data, background="subtract"))
    for name, one, told in (("same", config, False), ("other", other, True)):
        said: list[str] = []
        train(one, tmp_path / name, said, init=tmp_path / "one", stop_after=0)
        assert any("trained with --data.background keep, this run with subtract" in line for line in said) == told

    release_file = tmp_path / "one.safetensors"  # the same is told of weights that say how they saw touches
    assert main(["convert", str(tmp_path / "one"), str(release_file)]) == 0
    said = []
    train(other, tmp_path / "third", said, init=release_file, stop_after=0)
    assert any("trained with --data.background keep, this run with subtract" in line for line in said)


def test_what_starts_anew_is_told_of(straight, world, tmp_path):
    train(run_config(world, 2), tmp_path / "two", init=straight[0], stop_after=1)
    for name, init, told in (("a", straight[0], False), ("b", tmp_path / "two", True)):
        said: list[str] = []
        train(run_config(world, 2), tmp_path / name, said, init=init, stop_after=0)
        assert any("gives the touch encoder and the decoder; " in line for line in said) == told
    assert any("image, " in line and line.endswith("start untrained") for line in said)


def test_two_processes_never_train_one_run(straight, world, tmp_path):
    run = tmp_path / "r"
    for begun in (False, True):
        run.mkdir(exist_ok=True)
        with (run / ".lock").open("ab") as held:
            fcntl.flock(held, fcntl.LOCK_EX)  # as another process holds it, from before its first checkpoint
            before = sorted(path.name for path in run.iterdir())
            assert f"another process trains {run}" in refused(run_config(world, 2), run, init=straight[0])
            assert sorted(path.name for path in run.iterdir()) == before  # not even a tokenizer
        assert begun or train(run_config(world, 2), run, init=straight[0], stop_after=1).step == 1


def test_warm_up_is_an_epoch_where_the_run_is_long(world, tmp_path):
    epoch = Loader(manifests.read(world), run_config(world)).steps_per_epoch
    for steps, wanted in ((20 * epoch * 3, epoch), (20 * 2, min(epoch, 2))):
        run = tmp_path / str(steps)
        train(run_config(world, steps=steps), run, stop_after=0)
        assert from_json((run / "config.json").read_text()).optim.warmup == wanted
        train(run_config(world, steps=steps), run, stop_after=0)  # and goes on by the same command


def test_a_run_is_not_gone_on_with_on_other_rows(world, tmp_path):
    rows, file = [list(row.values()) for row in read_rows(world)], world.parent / "grown.csv"
    write_manifest(file, rows[:-1])
    train(run_config(file), tmp_path / "r", stop_after=1)
    write_manifest(file, rows)
    message = refused(run_config(file), tmp_path / "r")
    assert "have changed since" in message and "--init" in message
    moved = shutil.copytree(world.parent, tmp_path / "moved")
    write_manifest(moved / "other.csv", rows[:-1])  # the same rows and files at another place
    assert train(run_config(moved / "other.csv"), tmp_path / "r", stop_after=2).step == 2


def test_a_start_that_failed_leaves_no_tokenizer_behind_that_counts(straight, world, tmp_path):
    run = tmp_path / "r"
    refused(run_config(world, 2), run, init=tmp_path / "mistyped")
    assert not run.exists()
    run.mkdir()
    (run / "tokenizer.json").write_text("{}")  # of other data
    train(run_config(world, 2), run, init=straight[0], stop_after=0)
    assert texts.load_tokenizer(run / "tokenizer.json").vocab_size > 2


# Sensors ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("place", [len(SENSORS), 2], ids=["last", "in the middle"])
def test_a_new_sensor_keeps_the_tokens_of_the_old_ones(straight, world, tmp_path, place):
    run, stage1 = straight
    names = (*SENSORS[:place], "new_sensor", *SENSORS[place:])
    config = clips_only(run_config(world, 2, model={"sensors": names}))
    tokens = train(config, tmp_path / "r", init=run, stop_after=0).params["touch"]["sensor_tokens"]
    old = dict(zip(SENSORS, as_used(run, stage1)["touch"]["sensor_tokens"], strict=True))
    new = dict(zip(names, np.asarray(tokens), strict=True))
    for name in SENSORS:
        np.testing.assert_array_equal(new[name], old[name], err_msg=name)
    np.testing.assert_array_equal(new["new_sensor"], old["universal"])
    named = np.asarray(stage1.params["touch"]["sensor_tokens"])[SENSORS.index("allsight")]  # but never seen
    np.testing.assert_array_equal(new["allsight"], old["universal"])
    assert not np.array_equal(named, old["universal"])
    assert json.loads((tmp_path / "r" / "config.json").read_text())["model"]["sensors"] == list(names)


def test_the_authors_weights_start_sensors_that_they_never_saw_from_the_universal_tokens(world, tmp_path):
    config, init = run_config(world), tmp_path / "authors.safetensors"
    params = build(config.model).init(jax.random.key(5))
    safetensors.write_safetensors(init, convert.to_release(params, config.model), {"format": "pt"})
    first = train(config, tmp_path / "r", init=init, stop_after=1).params["touch"]["sensor_tokens"]  # at a rate of 0
    stored = np.asarray(params["touch"]["sensor_tokens"])
    for row in range(len(SENSORS)):
        np.testing.assert_array_equal(first[row], stored[row if row < 5 else -1], err_msg=SENSORS[row])
    assert checkpoint.read_metadata(tmp_path / "r")["seen"] == list(SENSORS[:5])
    said: list[str] = []
    train(run_config(world, model={"sensors": ("digit", "gelsight_mini", "universal")}), tmp_path / "few", said,
          init=init, stop_after=0)  # fmt: skip
    assert any(line.startswith(f"the tokens of gelsight, gelslim, duragel in {init} are left out") for line in said)


def test_tokens_of_a_sensor_that_are_left_behind_are_told_of(world, tmp_path):
    config = run_config(world)
    wide = replace(config.model, sensors=(*config.model.sensors[:-1], "my_gel", config.model.sensors[-1]))
    stored = checkpoint.Checkpoints(
        tmp_path / "one" / "checkpoints", keep=1, config_json=to_json(replace(config, model=wide)),
        metadata={"seen": ["digit", "my_gel"]},
    )  # fmt: skip
    stored.save(1, {"trainable": build(wide).init(jax.random.key(0))}, {"loss": 1.0})
    stored.close()
    for name, model, told in (("a", config.model, True), ("b", wide, False)):
        said: list[str] = []
        train(replace(run_config(world), model=model), tmp_path / name, said, init=tmp_path / "one", stop_after=0)
        assert any("the tokens of my_gel" in line and "--model.sensors " in line for line in said) == told, said
