import json
from dataclasses import replace

import jax
import numpy as np
import pytest
from tiny_models import tiny_config
from torch_files import tensor
from weights_world import (
    STAGE1,
    STAGE2,
    assert_same,
    openclip_of,
    params_of,
    save_clip,
    save_run,
    weights_of,
    write_heads,
)

from anytouch_jax.config import SENSORS, UNIVERSAL, to_json
from anytouch_jax.errors import UserError
from anytouch_jax.nn.functional import build
from anytouch_jax.weights.convert import resize_position, to_params, to_release
from anytouch_jax.weights.load import load_model, read_weights
from anytouch_jax.weights.safetensors import MODEL_KEY, export_safetensors, write_safetensors
from anytouch_jax.weights.start import first_params, load_init

TRAINED = ["digit", "gelsight_mini"]


@pytest.fixture
def stage1(tmp_path):
    """A stage-1 run of random parameters, trained on two sensors: (folder, config, parameters)."""
    config = tiny_config()
    params = params_of(config.model, seed=3)
    return save_run(tmp_path / "stage1", config, params, seen=TRAINED), config, params


def test_a_run_and_its_export_are_the_same_model(tmp_path):
    config = tiny_config(2)
    config = replace(config, data=replace(config.data, background="subtract"))
    params = params_of(config.model)
    run = load_model(save_run(tmp_path / "run", config, params, seen=TRAINED))
    # towers survive
    assert {"touch", "decoder", "image", "text", "matcher", "logit_scale"} <= run.params.keys()
    assert run.from_run and run.trained_sensors == tuple(TRAINED) and run.universal_drawn
    export_safetensors(tmp_path / "run.safetensors", run.params, run.export_metadata())
    file = load_model(tmp_path / "run.safetensors")
    assert_same(file.params, run.params)
    assert (file.config.model, file.config.data.background) == (run.config.model, "subtract")
    assert not file.from_run and file.trained_sensors == run.trained_sensors


def test_sensors_outside_training_get_the_universal_row(stage1):
    run, config, params = stage1
    tokens = load_model(run).params["touch"]["sensor_tokens"]
    for row, name in enumerate(config.model.sensors):
        expected = row if name in TRAINED else config.model.universal_row
        np.testing.assert_array_equal(
            tokens[row], params["touch"]["sensor_tokens"][expected], err_msg=name
        )
    never = replace(
        config, objective=replace(config.objective, universal_start=0.0, universal_end=0.0)
    )
    loaded = load_model(save_run(run.parent / "never", never, params, seen=TRAINED))
    rows = [config.model.sensors.index(name) for name in TRAINED]
    mean = params["touch"]["sensor_tokens"][rows].mean(axis=0)
    np.testing.assert_array_equal(
        loaded.params["touch"]["sensor_tokens"][config.model.universal_row], mean
    )
    assert not loaded.universal_drawn


def test_the_authors_weights_are_known_by_their_table(tmp_path):
    config = tiny_config()
    params = params_of(config.model)
    path = tmp_path / "authors.safetensors"
    write_safetensors(path, to_release(params, config.model), {"format": "pt"})
    write_heads(tmp_path, config.model)
    tokens = load_model(path).params["touch"]["sensor_tokens"]
    for row in range(len(SENSORS)):
        np.testing.assert_array_equal(
            tokens[row], params["touch"]["sensor_tokens"][row if row < 5 else -1]
        )
    stored = load_model(path, stored_rows=True)
    assert_same(stored.params, params)
    assert stored.trained_sensors == SENSORS[:5]
    few = replace(config.model, sensors=("digit", UNIVERSAL))
    write_safetensors(path, to_release(params_of(few), few), {})
    # of another table, and without metadata
    assert load_model(path).trained_sensors is None


def start(config, **paths):
    """`load_init` of fresh parameters: (fresh, first parameters, notes, sensors)."""
    fresh = build(config.model).init(jax.random.key(0))
    return fresh, *load_init(fresh, config, **paths)


def test_stage_two_takes_touch_and_decoder_of_stage_one(stage1):
    run, _, _ = stage1
    fresh, params, notes, sensors = start(tiny_config(2), init=run)
    loaded = load_model(run).params
    for part in fresh:
        assert_same({part: params[part]}, {part: loaded.get(part, fresh[part])})
    assert (notes, sensors) == ([], tuple(TRAINED))
    _, params, notes, sensors = start(tiny_config(2))
    assert_same(params, fresh)
    assert sensors == () and len(notes) == 1 and "--init" in notes[0]


@pytest.mark.parametrize("form", ["run", "file"])
def test_positions_are_resized_for_another_image_size(stage1, form):
    init, config, _ = stage1
    before = load_model(init)
    if form == "file":
        init = init.parent / "w.safetensors"
        metadata = {MODEL_KEY: before.export_metadata()[MODEL_KEY]}
        write_safetensors(init, to_release(before.params, config.model), metadata)
    _, params, notes, _ = start(tiny_config(image_size=56), init=init)
    for part in ("touch", "decoder"):
        table = before.params[part]["position"]
        assert len(params[part]["position"]) == 1 + 4 * (len(table) - 1)
        expected = resize_position(table, len(params[part]["position"]))
        np.testing.assert_allclose(params[part]["position"], expected, atol=1e-6)
    assert len(notes) == 1 and "positions" in notes[0] and "56 pixels" in notes[0]


@pytest.mark.parametrize("place", [len(SENSORS), 2], ids=["last", "in the middle"])
def test_a_new_sensor_keeps_the_tokens_of_the_old_ones(stage1, place):
    run, config, _ = stage1
    names = (*SENSORS[:place], "new_sensor", *SENSORS[place:])
    tokens = start(tiny_config(2, sensors=names), init=run)[1]["touch"]["sensor_tokens"]
    old = dict(
        zip(config.model.sensors, load_model(run).params["touch"]["sensor_tokens"], strict=True)
    )
    for name, row in zip(names, tokens, strict=True):
        np.testing.assert_array_equal(row, old.get(name, old[UNIVERSAL]), err_msg=name)


def test_tokens_and_backgrounds_that_change_are_reported(tmp_path):
    wide = tiny_config(sensors=(*SENSORS[:-1], "my_gel", UNIVERSAL))
    run = save_run(tmp_path / "run", wide, params_of(wide.model), seen=["digit", "my_gel"])
    assert start(wide, init=run)[2] == []
    (note,) = start(tiny_config(), init=run)[2]
    assert "my_gel" in note and "--model.sensors " in note
    other = replace(wide, data=replace(wide.data, background="subtract"))
    (note,) = start(other, init=run)[2]
    assert "--data.background keep" in note and "subtract" in note


def test_a_start_that_does_not_fit_names_the_options(stage1, tmp_path):
    run, config, params = stage1
    touch = config.model.touch
    wide = replace(touch, width=32, heads=1)
    for model, options in (
        ({"embed": 16}, "--model.embed 12"),
        (
            {"embed": 16, "touch": wide},
            "--model.embed 12 --model.touch.width 16 --model.touch.heads 2",
        ),
        ({"touch": replace(touch, heads=1)}, "--model.touch.heads 2"),
        ({"activation": "quick_gelu"}, "--model.activation gelu"),
    ):
        with pytest.raises(UserError) as caught:
            start(tiny_config(2, **model), init=run)
        assert str(caught.value).endswith(f"add {options}") and "\n" not in str(caught.value)
    small = replace(tiny_config(2, touch=wide), preset="small")
    with pytest.raises(UserError, match=r"add --preset tiny$"):
        start(small, init=run)
    file = tmp_path / "authors.safetensors"  # without metadata
    write_safetensors(file, to_release(params, config.model), {})
    with pytest.raises(UserError, match=r"heads of .*touch \(width 16\).*config\.json"):
        start(tiny_config(2), init=file)
    write_heads(tmp_path, config.model)
    start(tiny_config(2), init=file)
    with pytest.raises(UserError, match=r"--model\.touch\.heads 2$"):
        start(tiny_config(2, touch=replace(touch, heads=1)), init=file)
    export_safetensors(
        tmp_path / "half.safetensors", {"touch": params["touch"]}, load_model(run).export_metadata()
    )
    assert any(
        "the decoder starts untrained" in note
        for note in start(tiny_config(1), init=tmp_path / "half.safetensors")[2]
    )
    # as the encoders of the package
    result = start(tiny_config(2), init=tmp_path / "half.safetensors")
    assert not any("decoder" in note for note in result[2])
    assert np.array_equal(result[1]["touch"]["class_token"], params["touch"]["class_token"])


def test_clip_gives_the_towers_and_without_stage_one_the_touch_encoder(stage1, tmp_path):
    config = tiny_config(2, "paper", "pretrained")
    clip = params_of(config.model, seed=9)
    folder = save_clip(tmp_path / "clip", config.model, clip)
    for init in (stage1[0], None):
        fresh, params, _, _ = start(config, init=init, clip=folder)
        for part in ("image", "text", "logit_scale"):
            assert_same({part: params[part]}, {part: clip[part]})
        assert_same(params["lora"], fresh["lora"])
        loaded = clip["image"] if init is None else load_model(init).params["touch"]
        np.testing.assert_array_equal(params["touch"]["position"], loaded["position"])
    text_only = replace(config, model=replace(config.model, image=None, lora_rank=0))
    params = start(text_only, clip=folder)[1]
    np.testing.assert_array_equal(params["touch"]["position"], clip["image"]["position"])
    # stage 1
    params = start(tiny_config(), clip=folder / "model.safetensors")[1]
    # repeated, not divided (golden Q1)
    for frame in params["touch"]["patch"]["kernel"]:
        np.testing.assert_array_equal(frame, clip["image"]["patch"]["kernel"])


@pytest.mark.parametrize("stage", [1, 2])
@pytest.mark.parametrize(
    ("file", "content"),
    [
        (
            "config.json",
            {
                "text_config": {"hidden_act": "quick_gelu"},
                "vision_config": {"hidden_act": "quick_gelu"},
            },
        ),
        ("config.json", {"model_type": "clip", "vision_config": {}}),  # HF's default
        ("open_clip_config.json", {"model_cfg": {"quick_gelu": True}}),
    ],
)
def test_clip_weights_of_another_activation_are_refused(tmp_path, file, content, stage):
    config = tiny_config(2, "paper", "pretrained")
    folder = save_clip(tmp_path / "clip", config.model, params_of(config.model))
    (folder / file).write_text(json.dumps(content))
    for path in (folder, folder / "model.safetensors"):
        with pytest.raises(
            UserError, match=r"model\.safetensors .* --model\.activation quick_gelu"
        ):
            start(config if stage == 2 else tiny_config(), clip=path)


@pytest.mark.parametrize("layout", ["clip", "openclip"])
@pytest.mark.parametrize("own", [False, True], ids=["shared", "own patch encoders"])
def test_clip_starts_the_touch_encoder(layout, own):
    clip = weights_of(STAGE2, "clip")
    tower = to_params(clip, STAGE2)
    weights = clip if layout == "clip" else openclip_of(clip)
    model = replace(STAGE1, patch_encoder="sensor" if own else "shared")
    fresh = params_of(model, seed=1)
    params = first_params(fresh, model, clip=weights)
    # kept, as the sensor tokens are
    assert_same(params["decoder"], fresh["decoder"])
    np.testing.assert_array_equal(params["touch"]["sensor_tokens"], fresh["touch"]["sensor_tokens"])
    for part in ("class_token", "position", "pre_norm", "blocks", "post_norm", "projection"):
        assert_same({part: params["touch"][part]}, {part: tower["image"][part]})
    kernel = clip["vision_model.embeddings.patch_embedding.weight"]
    # golden Q1: not divided
    inflated = np.repeat(kernel[:, None], 3, axis=1)
    for row in params["touch"]["patch"]["kernel"] if own else [params["touch"]["patch"]["kernel"]]:
        one = {**params, "touch": {**params["touch"], "patch": {"kernel": row}}}
        theirs = to_release(one, STAGE1)["video_patch_embedding.weight"]
        np.testing.assert_allclose(theirs, inflated, rtol=1e-7)
    # the given tree is not written to
    assert_same({"fresh": fresh}, {"fresh": params_of(model, seed=1)})


def test_files_of_every_kind_hold_the_same(write_torch, tmp_path):
    weights = weights_of(STAGE1)
    params = to_params(weights, STAGE1)
    write_safetensors(
        tmp_path / "w.safetensors",
        {k: v.T.copy().T for k, v in weights.items()},
        {"source": "test"},
    )
    np.savez(tmp_path / "w.npz", **weights)
    write_torch({"model": {key: tensor(value) for key, value in weights.items()}}, "w.pth")
    write_torch({key: tensor(value) for key, value in weights.items()}, "w.bin", legacy=True)
    for name in ("w.safetensors", "w.npz", "w.pth", "w.bin"):
        assert_same(to_params(read_weights(tmp_path / name), STAGE1), params)
    assert not list(tmp_path.glob(".*"))  # no leftovers of the atomic write


@pytest.mark.parametrize(
    "prefix", ["module.", "_orig_mod.", "module._orig_mod.", "model.", "model._orig_mod."]
)
def test_prefixes_are_removed_in_every_format(write_torch, tmp_path, prefix):
    weights = {f"{prefix}{key}": value for key, value in weights_of(STAGE1).items()}
    write_safetensors(tmp_path / "w.safetensors", weights, {})
    np.savez(tmp_path / "w.npz", **weights)
    content = {"state_dict_ema": {key: tensor(value) for key, value in weights.items()}, "epoch": 3}
    write_torch(content, "w.ckpt")
    for name in ("w.safetensors", "w.npz"):
        assert_same(read_weights(tmp_path / name), weights_of(STAGE1))
    with pytest.warns(UserWarning, match=r"w\.ckpt has no plain weights.*state_dict_ema"):
        assert_same(read_weights(tmp_path / "w.ckpt"), weights_of(STAGE1))


def test_weights_in_parts_are_read_by_their_index(tmp_path):
    weights = weights_of(STAGE1)
    homes = {key: f"model-0000{1 + i % 2}-of-00002.safetensors" for i, key in enumerate(weights)}
    for part in set(homes.values()):
        write_safetensors(
            tmp_path / part, {key: weights[key] for key in weights if homes[key] == part}, {}
        )
    with pytest.raises(UserError, match=r"one of 2 parts.*model\.safetensors\.index\.json"):
        read_weights(tmp_path / "model-00001-of-00002.safetensors")
    index = tmp_path / "model.safetensors.index.json"
    index.write_text(json.dumps({"metadata": {"total_size": 1}, "weight_map": homes}))
    write_heads(tmp_path, STAGE1)
    for path in (index, tmp_path / "model-00002-of-00002.safetensors"):
        assert_same(read_weights(path), weights)
    assert_same(load_model(tmp_path, stored_rows=True).params, to_params(weights, STAGE1))
    (tmp_path / "model-00002-of-00002.safetensors").unlink()
    with pytest.raises(UserError, match=r"model-00002-of-00002\.safetensors, which is not there"):
        load_model(tmp_path)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("form", ["run", "file"])
def test_weights_that_are_not_finite_are_refused_by_name(tmp_path, form, value):
    config = tiny_config()
    params = params_of(config.model)
    params["decoder"]["mask_token"].flat[0] = value
    path = (
        save_run(tmp_path / "run", config, params) if form == "run" else tmp_path / "w.safetensors"
    )
    if form == "file":
        export_safetensors(path, params, {MODEL_KEY: to_json(config.model)})
    with pytest.raises(UserError, match="decoder/mask_token has values that are not finite"):
        load_model(path)


@pytest.mark.parametrize("name", ["w.pth", "w.safetensors", "w.npz"])
def test_a_web_page_and_a_pointer_are_called_so(tmp_path, name):
    texts = {
        "a web page": "\n<!DOCTYPE html><html>",
        "a Git LFS pointer": "version https://git-lfs.github.com/spec/v1",
    }
    for kind, text in texts.items():
        (tmp_path / name).write_text(text)
        with pytest.raises(UserError, match=f"is {kind}"):
            load_model(tmp_path / name)


# torch.nn.functional.interpolate(mode="bicubic", align_corners=False) of arange(9)**2 % 7 as a 3 x
# 3 image
UP = [
    [-0.220484018, 0.204530478, 2.152891397, 4.220484257],
    [1.355409384, 1.418546438, 2.801180124, 4.506895065],
    [1.893125772, 1.390535593, 1.888761282, 3.028749228],
    [1.005151987, 0.140684366, 0.073182821, 0.851293325],
]
DOWN = [[0.572738647, 3.497573853], [1.071792603, 1.381332397]]


@pytest.mark.parametrize("expected", [UP, DOWN])
def test_equal_to_torch(expected):
    table = np.concatenate(
        [[[100.0, -100.0]], np.stack([np.arange(9) ** 2 % 7, -(np.arange(9) ** 2 % 7)], 1)]
    )
    flat = np.ravel(expected)
    resized = resize_position(table.astype("f4"), 1 + len(flat))
    assert resized.dtype == np.float32
    # the class token's row
    np.testing.assert_array_equal(resized[0], table[0])
    np.testing.assert_allclose(resized[1:], np.stack([flat, -flat], 1), atol=1e-6)
