from dataclasses import replace
from pathlib import Path

import huggingface_hub
import jax
import pytest

import anytouch_jax as at
from anytouch_jax.weights import registry
from anytouch_jax.weights.load import Loaded
from anytouch_jax.weights.safetensors import WeightsError
from tests.support.tiny_models import tiny_config


def write_encoder(folder: Path, background: str = "either") -> Path:
    """Write the encoder of an untrained run of both stages, with a card."""
    config = tiny_config(stage=2)
    config = replace(config, data=replace(config.data, background=background))
    params = at.build(config.model).init(jax.random.key(0))
    loaded = Loaded(folder, params, config, ("digit",), True, {}, True)
    return registry.write_encoder(folder, loaded, "## Limits\n\nNone are known.")


@pytest.fixture
def packaged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a package with one encoder, `little`."""
    write_encoder(tmp_path / "package" / "little")
    monkeypatch.setattr(registry, "FOLDER", tmp_path / "package")
    registry._packaged.cache_clear()
    return tmp_path / "package"


def test_a_name_comes_before_a_folder_of_that_name(packaged, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_encoder(tmp_path / "little", background="subtract")
    assert not at.load_encoder("little").needs_background
    assert at.load_encoder("./little").needs_background


def test_damaged_weights_of_the_package_are_refused(packaged):
    file = packaged / "little" / registry.WEIGHTS
    content = bytearray(file.read_bytes())
    content[-1] ^= 1
    file.write_bytes(bytes(content))
    with pytest.raises(at.UserError, match="little in the package are damaged"):
        at.load_encoder("little")


@pytest.mark.parametrize(
    ("address", "revision"),
    [("hf://user/repo", None), (Path("hf://user/repo"), None), ("hf://user/repo@v1", "v1")],
)
def test_a_repository_of_the_hub_is_loaded(tmp_path, monkeypatch, address, revision):
    folder = write_encoder(tmp_path / "snapshot")
    asked = []

    needed = [
        "preprocessor_config.json",
        "model.safetensors.index.json",
        "sparsh.ckpt",
        "encoders/digit.pth",
    ]
    needed += ["calibration/0000.png", "config.json", "tokenizer.json", "model.safetensors"]

    def snapshot_download(repository, *, revision, allow_patterns):
        asked.append((repository, revision))
        names = [*needed, "flax_model.msgpack", "image.png"]
        assert (
            list(huggingface_hub.utils.filter_repo_objects(names, allow_patterns=allow_patterns))
            == needed
        )
        return str(folder)

    monkeypatch.setattr(huggingface_hub, "snapshot_download", snapshot_download)
    assert at.load_encoder(address).subtracts
    assert asked == [("user/repo", revision)]


def test_a_repository_that_cannot_be_had_is_one_sentence(monkeypatch):
    def snapshot_download(*_, **__):
        raise OSError("404: there is no such repository\n" + "and a page of advice " * 100)

    monkeypatch.setattr(huggingface_hub, "snapshot_download", snapshot_download)
    with pytest.raises(at.UserError) as caught:
        at.load_encoder("hf://user/nothing")
    assert str(caught.value) == "Cannot get hf://user/nothing: 404: there is no such repository"
    with pytest.raises(at.UserError, match="is not an address on the hub"):
        at.load_encoder("hf://justone")


def test_a_folder_to_upload_has_a_card_and_what_zero_shot_questions_need(tmp_path):
    folder = write_encoder(tmp_path / "mine")
    page = (folder / "README.md").read_text()
    assert (
        page.startswith("---\nlibrary_name: anytouch_jax\n")
        and "## Limits" in page
        and "| digit |" in page
    )
    encoder = at.load_encoder(folder)
    assert set(encoder.others) == {"text", "logit_scale"} and encoder.trained_sensors == ("digit",)
    assert encoder.config.model.match_head == "none"


def test_values_that_float16_cannot_hold_are_refused(tmp_path):
    config = tiny_config()
    params = at.build(config.model).init(jax.random.key(0))
    params["touch"]["class_token"] = params["touch"]["class_token"] + 1e6
    with pytest.raises(WeightsError, match="touch/class_token has values above 65504"):
        registry.write_encoder(
            tmp_path / "large", Loaded(tmp_path, params, config, None, True, {}, True)
        )
