import json
import re
import shutil
from pathlib import Path

import jax
import numpy as np
import pytest
from PIL import Image
from safetensors.numpy import save_file
from torch_files import Call, Global, tensor, zip_bytes

from anytouch_jax.config import UNIVERSAL, ModelConfig, Stack
from anytouch_jax.errors import UserError
from anytouch_jax.nn.vit import VitConfig
from anytouch_jax.weights.convert import file_shapes
from anytouch_jax.weights.load import load_model
from anytouch_jax.zoo.encoder import family_encoder, prepare
from anytouch_jax.zoo.families import FAMILIES, entries_of, load_family

BY_TITLE = {family.title: family for family in FAMILIES}
SPARSH = "Sparsh"
VIDEO = "Sparsh V-JEPA"
TOUCH2 = "AnyTouch 2"
SITR = "SITR"
T3 = "T3"
HF = "DINOv2 (Hugging Face)"
AUTHORS = "DINOv2 (its authors' layout)"
TIMM = "ViT, DeiT or MAE (timm's layout)"
MAE = "ViT-MAE (Hugging Face)"
VIT = "ViT or DeiT (Hugging Face)"
OUT = {"outputs": 7}
PAIRS = OUT | {"tubelet": 2}
# family, (width, depth, heads, mlp), patch, what else differs, size of the images, given to the
# loader
FORMS = [
    (SPARSH, (38, 3, 2, 50), 8, {"tubelet": 2, "frames": 2, "registers": 1}, (32, 24), True),
    (SPARSH, (24, 1, 4, 96), 16, {"tubelet": 3, "frames": 3}, (320, 240), False),
    (VIDEO, (20, 2, 2, 30), 8, {"tubelet": 2, "frames": 4, "axes": 3}, (40, 16), True),
    (VIDEO, (20, 2, 5, 30), 8, {"tubelet": 2, "frames": 4, "grid": (2, 8, 6)}, (64, 48), False),
    (VIDEO, (20, 2, 5, 30), 8, {"tubelet": 2, "frames": 4, "grid": (2, 5, 5)}, (40, 40), False),
    (VIDEO, (20, 2, 5, 30), 4, {"tubelet": 2, "frames": 8, "grid": (4, 4, 3)}, (16, 12), True),
    (
        TOUCH2,
        (24, 3, 3, 40),
        8,
        PAIRS | {"frames": 4, "grid": (2, 5, 5), "tokens": (7, 3)},
        (40, 40),
        False,
    ),
    (
        TOUCH2,
        (8, 1, 2, 8),
        8,
        OUT | {"tubelet": 4, "frames": 4, "grid": (1, 2, 2), "tokens": (2, 1)},
        (16, 16),
        False,
    ),
    (
        TOUCH2,
        (24, 1, 3, 40),
        8,
        PAIRS | {"frames": 8, "grid": (4, 3, 3), "tokens": (9, 2)},
        (24, 24),
        True,
    ),
    (
        SITR,
        (18, 2, 3, 20),
        8,
        {"grid": (1, 4, 4), "calibration": 9, "outputs": 11},
        (32, 32),
        False,
    ),
    (SITR, (18, 1, 3, 20), 8, {"grid": (1, 2, 3), "outputs": 5}, (16, 24), True),
    (T3, (24, 1, 4, 48), 8, {"grid": (1, 5, 5), "trunk": 4}, (40, 40), False),
    (T3, (24, 3, 4, 48), 8, {"grid": (1, 5, 5), "trunk": 1}, (24, 16), True),
    (
        HF,
        (36, 2, 3, 72),
        7,
        {"grid": (1, 6, 6), "registers": 3, "layer_scale": True},
        (224, 224),
        False,
    ),
    (HF, (36, 1, 3, 72), 7, {"grid": (1, 9, 9), "layer_scale": True}, (21, 35), True),
    (
        AUTHORS,
        (30, 3, 5, 72),
        14,
        {"grid": (1, 4, 4), "registers": 2, "layer_scale": True},
        (224, 224),
        False,
    ),
    (MAE, (16, 2, 2, 32), 32, {"grid": (1, 3, 3)}, (96, 96), False),
    (VIT, (16, 2, 4, 32), 4, {"grid": (1, 7, 7)}, (12, 20), True),
    (TIMM, (28, 2, 7, 60), 8, {"grid": (1, 6, 6)}, (48, 48), False),
    (TIMM, (28, 2, 7, 60), 8, {"grid": (1, 3, 5)}, (24, 40), True),
]


def made(title, stack, patch, more, size):
    """The family, the form of its network, and random arrays of a file of this form."""
    family = BY_TITLE[title]
    more = dict(more)
    rows, tokens = more.pop("tokens", (1, 0))
    numbered = tuple(f"sensor{row}" for row in range(rows - 1))
    names = (*family.names[: rows - 1], *numbered[len(family.names) :])
    stack = Stack(*stack)
    model = ModelConfig(
        max(size),
        patch,
        more.get("outputs", 0) or stack.width,
        stack,
        Stack(512, 8, 16, 2048),
        frames=more.pop("frames", 1),
        sensors=(*names, UNIVERSAL),
        sensor_tokens=tokens,
        norm_eps=family.eps,
    )
    plain = {"layer_scale": family.name == "sparsh", "class_token": family.name != "sparsh"}
    plain |= {
        "patch_bias": title != TOUCH2,
        "pre_norm": title == TOUCH2,
        "output_bias": title == SITR,
    }
    plain["resample"] = (
        "antialias" if family.name == "dinov2" and "registers" in more else family.resample
    )
    form = VitConfig(model, **(plain | more))
    shapes = file_shapes(*entries_of(family, form))
    rng = np.random.default_rng(0)
    arrays = {
        f"{family.prefixes[0]}{key}": rng.normal(size=shape).astype("f4")
        for key, shape in shapes.items()
    }
    return (
        family,
        form,
        arrays | ({family.beside: np.zeros((1, 1, 8), "f4")} if family.beside else {}),
    )


def write_t3(folder: Path, arrays) -> Path:
    (folder / "encoders").mkdir(parents=True)
    parts = {True: {}, False: {}}
    for key, array in arrays.items():
        parts[key.startswith("trunk.")][key.removeprefix("trunk.")] = tensor(array)
    (folder / "trunk.pth").write_bytes(zip_bytes(parts[True]))
    (folder / "encoders" / "digit.pth").write_bytes(zip_bytes(parts[False]))
    return folder / "encoders" / "digit.pth"


@pytest.mark.parametrize(("title", "stack", "patch", "more", "size", "given"), FORMS)
def test_the_form_follows_the_arrays(title, stack, patch, more, size, given, tmp_path):
    family, form, arrays = made(title, stack, patch, more, size)
    file = tmp_path / "model.safetensors"
    if title == T3:
        file = write_t3(tmp_path, arrays)
    else:
        save_file(arrays, file)
    model, _ = load_family(file, heads=stack[2], image_size=size if given else None)
    assert model.family.title == title and model.image_size == size
    sensors = model.form.model.sensors
    assert model.form == form if title != T3 else sensors == ("digit", UNIVERSAL)
    encoder = family_encoder(model, str(file), file)
    if form.calibration:
        gel = np.zeros((*size, 3), np.uint8)
        encoder = encoder.calibrated([gel] * form.calibration, gel)
    clip = jax.ShapeDtypeStruct((2, form.model.frames, *size, 3), np.float32)
    row = jax.ShapeDtypeStruct((2,), np.int32)
    assert jax.eval_shape(encoder.traceable(), encoder.params, clip, row).shape == (
        2,
        form.model.embed,
    )
    places = int(np.prod(size)) // patch**2 * (form.model.frames // form.tubelet)
    start = 0 if family.tokens == "patches" else form.start
    assert jax.eval_shape(encoder._tokens, encoder.params, clip, row).shape == (
        2,
        start + places,
        stack[0],
    )


def test_what_the_arrays_do_not_say_is_asked_for(tmp_path):
    save_file(made(*FORMS[-1][:5])[2], file := tmp_path / "model.safetensors")
    for given, words in (
        ({"heads": 7}, "no grid of patches; give the image_size"),
        ({"image_size": (24, 40)}, r"number of attention heads of touch \(width 28\)"),
        ({"heads": 7, "image_size": (24, 44)}, "no multiple of the patches of 8"),
    ):
        with pytest.raises(UserError, match=words):
            load_family(file, **given)
    (tmp_path / "config.json").write_text(
        json.dumps({"num_attention_heads": 7, "hidden_act": "quick_gelu"})
    )
    with pytest.raises(UserError, match=r"hidden_act of the config\.json is quick_gelu"):
        load_family(file, image_size=(24, 40))
    (tmp_path / "config.json").unlink()
    _, _, arrays = made(*FORMS[-2][:5])
    # it takes no memory
    arrays["blocks.999999999.norm1.weight"] = arrays.pop("blocks.1.norm1.weight")
    save_file(arrays, file)
    with pytest.raises(UserError, match=r"'blocks\.1\.norm1\.weight' is missing"):
        load_family(file, heads=7)


KINDS = ("safetensors", "pth", "ckpt", "safetensors parts", "bin parts")
SMALL = {form[0]: form for form in reversed(FORMS) if form[0] != T3}
EVIL = Call(Global("os", "system"), ("touch hacked",))


def write(folder: Path, kind: str, arrays, extra=None) -> tuple[Path, Path]:
    """Write a file; return what is loaded and the file to damage, whose pickle may also hold
    `extra`.
    """
    folder.mkdir()
    suffix = kind.split()[0]
    if kind.endswith("parts"):
        names = sorted(arrays)
        where = {}
        for part in (0, 1):
            file = folder / f"model-{part + 1:05d}-of-00002.{suffix}"
            own = {name: arrays[name] for name in names[part::2]}
            where |= dict.fromkeys(own, file.name)
            save(file, own, extra if part else None)
        index = folder / f"model.{suffix}.index.json"
        index.write_text(json.dumps({"weight_map": where}))
        return index, file
    file = folder / f"model.{suffix}"
    save(file, arrays, extra)
    return file, file


def save(file: Path, arrays, extra) -> None:
    if file.suffix == ".safetensors":
        save_file(arrays, file)
        return
    content = {name: tensor(array) for name, array in arrays.items()}
    if file.suffix == ".ckpt":
        content = {"epoch": 3, "state_dict": content, "optimizer_states": [{"lr": 0.1}]}
    file.write_bytes(zip_bytes(content | ({"extra": extra} if extra else {})))


def refused(file: Path, named: Path, heads: int, words: str) -> None:
    with pytest.raises(UserError, match=words) as raised:
        load_family(file, heads=heads)
    text = str(raised.value)
    assert named.name in text and "\n" not in text and len(text) < 600


@pytest.mark.parametrize(
    ("title", "kind"), [*zip(SMALL, KINDS * 2, strict=False)]
)  # the kinds take turns
def test_a_whole_file_is_read_and_a_damaged_one_is_one_sentence(title, kind, tmp_path, monkeypatch):
    _, stack, patch, more, size, given = SMALL[title]
    family, _, arrays = made(title, stack, patch, more, size)
    monkeypatch.chdir(tmp_path)
    file, damaged = write(tmp_path / "whole", kind, arrays)
    model, _ = load_family(file, heads=stack[2], image_size=size if given else None)
    assert model.family.title == title
    damaged.write_bytes(damaged.read_bytes()[:-1000])
    refused(file, damaged, stack[2], "not a whole safetensors|damaged or not a torch|cut short")
    needed = {f"{family.prefixes[0]}{key}" for key in family.needs}
    blocks = re.compile(r".*(blocks|layers?)\.0\..*")
    lost = next(key for key in sorted(arrays) if blocks.fullmatch(key) and key not in needed)
    file, _ = write(
        tmp_path / "lost", kind, {key: array for key, array in arrays.items() if key != lost}
    )
    refused(file, file, stack[2], "missing")
    if "safetensors" not in kind:
        file, damaged = write(tmp_path / "evil", kind, arrays, EVIL)
        refused(file, damaged, stack[2], r"'os\.system'.*nothing was run")
        assert not (tmp_path / "hacked").exists()


@pytest.mark.parametrize("part", ["trunk.pth", "encoders/digit.pth"])
def test_a_damaged_or_lonely_part_of_t3_is_one_sentence(part, tmp_path):
    _, stack, patch, more, size, _ = next(form for form in FORMS if form[0] == T3)
    file = write_t3(tmp_path / "t3", made(T3, stack, patch, more, size)[2])
    damaged = tmp_path / "t3" / part
    refused(tmp_path / "t3" / "trunk.pth", tmp_path / "trunk.pth", stack[2], "trunk of T3 alone")
    refused(alone := Path(shutil.copy(file, tmp_path)), alone, stack[2], "put its trunk.pth")
    save_file({"layer.weight": np.zeros((2, 2), "f4")}, other := tmp_path / "other.safetensors")
    with pytest.raises(UserError, match="not weights of"):
        load_model(other)
    damaged.write_bytes(damaged.read_bytes()[:-1000])
    refused(file, damaged, stack[2], "damaged or not a torch file|cut short")
    damaged.write_bytes(zip_bytes({"model": EVIL}))
    refused(file, damaged, stack[2], "nothing was run")


RNG = np.random.default_rng(0)
FRAME = RNG.integers(0, 256, (60, 80, 3), np.uint8)
SIDE = {"height": 48, "width": 48}
CLIP = {
    "size": {"shortest_edge": 52},
    "crop_size": SIDE,
    "do_center_crop": True,
    "image_mean": [0.1] * 3,
    "image_std": [0.2] * 3,
    "resample": 3,
}
TIMM_CFG = {
    "mean": [0.5] * 3,
    "std": [0.5] * 3,
    "crop_pct": 0.9,
    "interpolation": "bicubic",
    "input_size": [3, 48, 48],
}


def resized(size, kernel):
    return np.asarray(Image.fromarray(FRAME).resize(size[::-1], kernel), np.float32)


def cropped(short, kernel, side=48):
    """What torchvision's Resize(short) and CenterCrop(side) return."""
    pixels = resized((short, int(short * 80 / 60)), kernel)
    top, left = (round((length - side) / 2) for length in pixels.shape[:2])
    return pixels[top : top + side, left : left + side]


BILINEAR = Image.Resampling.BILINEAR
BICUBIC = Image.Resampling.BICUBIC
LANCZOS = Image.Resampling.LANCZOS


@pytest.mark.parametrize(
    ("stated", "expected", "ignored"),
    [
        (
            {"config": {"architecture": "vit", "pretrained_cfg": TIMM_CFG}},
            (cropped(53, BICUBIC) / 255 - 0.5) / 0.5,
            "",
        ),
        (
            {
                "config": {"architecture": "vit"}
                | TIMM_CFG
                | {"crop_pct": 1.0, "interpolation": "bilinear"}
            },
            (cropped(48, BILINEAR) / 255 - 0.5) / 0.5,
            "",
        ),
        (
            {"config": {"pretrained_cfg": TIMM_CFG | {"crop_mode": "squash", "crop_pct": 1.0}}},
            (resized((48, 48), BICUBIC) / 255 - 0.5) / 0.5,
            "",
        ),
        (
            {"config": {"pretrained_cfg": TIMM_CFG | {"crop_mode": "border"}}},
            None,
            "crop_mode border with crop_pct",
        ),
        ({"preprocessor_config": CLIP}, (cropped(52, BICUBIC) / 255 - 0.1) / 0.2, ""),
        (
            {"preprocessor_config": CLIP | {"size": 52, "crop_size": 48, "resample": 1}},
            (cropped(52, LANCZOS) / 255 - 0.1) / 0.2,
            "",
        ),
        (
            {"preprocessor_config": {"size": SIDE, "resample": 2, "do_normalize": False}},
            resized((48, 48), BILINEAR) / 255,
            "",
        ),
        (
            {
                "preprocessor_config": {
                    "size": 48,
                    "resample": 2,
                    "image_mean": [0.5] * 3,
                    "image_std": [0.5] * 3,
                    "rescale_factor": 1 / 127.5,
                }
            },
            (resized((48, 48), BILINEAR) / 127.5 - 0.5) / 0.5,
            "",
        ),
        (
            {
                "preprocessor_config": {
                    "size": 48,
                    "resample": 2,
                    "image_mean": [9.0] * 3,
                    "image_std": [3.0] * 3,
                    "do_rescale": False,
                }
            },
            (resized((48, 48), BILINEAR) - 9) / 3,
            "",
        ),
        (
            {"preprocessor_config": CLIP, "config": {"pretrained_cfg": TIMM_CFG}},
            (cropped(52, BICUBIC) / 255 - 0.1) / 0.2,
            "",
        ),
        (
            {"preprocessor_config": CLIP | {"do_pad": True, "pad_size": SIDE}},
            None,
            "do_pad True, pad_size",
        ),
        (
            {"preprocessor_config": {"size": {"shortest_edge": 52}}},
            None,
            "size {'shortest_edge': 52}",
        ),
        ({"preprocessor_config": {"size": 47}}, None, "an input of 47 x 47 pixels"),
        (
            {
                "config": {
                    "preparation": {"mean": [0.3] * 3, "std": [1.0] * 3},
                    "pretrained_cfg": TIMM_CFG,
                }
            },
            cropped(53, BICUBIC) / 255 - 0.3,
            "",
        ),
    ],
)
@pytest.mark.parametrize("title", [TIMM, HF])
def test_what_is_stated_beside_the_weights_is_computed_or_named(
    tmp_path, recwarn, title, stated, expected, ignored
):
    more = {"grid": (1, 6, 6)} | ({"layer_scale": True} if title == HF else {})
    save_file(
        made(title, (16, 1, 2, 32), 8, more, (48, 48))[2], str(tmp_path / "model.safetensors")
    )
    for name, content in stated.items():
        (tmp_path / f"{name}.json").write_text(json.dumps(content))
    model, _ = load_family(tmp_path, heads=2)
    words = " ".join(str(one.message) for one in recwarn)
    assert (ignored in words) if ignored else not words
    if expected is not None:
        assert model.image_size == (48, 48)
        np.testing.assert_allclose(
            prepare(FRAME, None, model.preparation, model.image_size), expected, atol=1e-5
        )
