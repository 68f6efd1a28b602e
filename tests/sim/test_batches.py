from dataclasses import replace
from functools import partial
from itertools import count
from types import SimpleNamespace

import cv2
import jax
import numpy as np
import pytest
from batch_leaves import assert_same
from runs import read_metrics

from anytouch_jax.config import Stack, preset
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.sim.batches import SIMULATED, SimulatedLoader, _partners, caption_tokenizer
from anytouch_jax.sim.preparation import MOVED, field_batch, misregistered_background
from anytouch_jax.sim.real import load_real
from anytouch_jax.train import pace
from anytouch_jax.training import pretrain

TINY = Stack(width=16, depth=1, heads=2, mlp=16)


def tiny(stage=1, **changes):
    config = preset("tiny", stage=stage)
    model = replace(
        config.model,
        image_size=28,
        touch=TINY,
        decoder=TINY,
        embed=8,
        fields=4 if stage == 1 else 0,
    )
    if stage == 2:
        text = replace(config.model.text, stack=TINY)
        model = replace(model, image=TINY, text=text, match_head="cosine")
    settings = {
        "data.manifests": (SIMULATED,),
        "data.batch_size": 8,
        "data.clip_fraction": 0.0,
        "data.jitter": (0.0,) * 4,
        "data.background": "either",
        "simulated.objects": 13,
        "simulated.sensors": ("digit", "gelsight_mini"),
        "simulated.places": 2,
        "run.steps": 4,
        "run.save_every": 1,
        "run.figure_every": 0,
    }
    return replace(config, model=model).with_settings(settings | changes)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """Two units that touch two places, four frames each, one without an image of its gel."""
    folder = tmp_path_factory.mktemp("real")
    rng = np.random.default_rng(0)
    lines = ["path,sensor,sequence,frame_index,split,touch,unit,background_path,text"]
    for unit in ("left", "right"):
        cv2.imwrite(str(folder / f"{unit}.png"), np.full((40, 40, 3), 90, np.uint8))
        for number in range(8):
            name = f"{unit}{number}.png"
            cv2.imwrite(str(folder / name), rng.integers(0, 255, (40, 40, 3), np.uint8))
            gel = "left.png" if unit == "left" else ""
            sequence = number // 4
            lines.append(
                f"{name},gelsight_mini,{unit}{sequence},{number % 4},train,p{sequence},{unit},"
                f"{gel},soft"
            )
    (folder / "manifest.csv").write_text("\n".join(lines) + "\n")
    return folder / "manifest.csv"


def test_a_batch_depends_on_seed_and_step_alone():
    config = tiny(**{"simulated.reuse": 2})
    loader = SimulatedLoader(config)
    again = SimulatedLoader(config)
    batches = [loader.batch(step) for step in range(3)]
    assert_same(batches[2][:2], again.batch(2)[:2])
    assert batches[0].clip.shape == (8, 1, 28, 28, 3) and batches[0].fields.depth.shape == (
        4,
        14,
        14,
    )
    changes = [
        np.abs(np.asarray(batches[n].clip, int) - np.asarray(batches[0].clip, int)).max()
        for n in (1, 2)
    ]
    assert min(changes) > 0, "a touch that is drawn again differs by light, another one altogether"
    other = SimulatedLoader(config.with_settings({"run.seed": 1})).batch(0)
    assert np.abs(np.asarray(other.clip, int) - np.asarray(batches[0].clip, int)).max() > 0
    assert loader.trained_sensors == ["digit", "gelsight_mini"]


@pytest.mark.slow
def test_stage_2_mixes_simulated_and_real_pairs(recordings):
    config = tiny(
        2, **{"data.weights": ((SIMULATED, 1.0),), "data.manifests": (SIMULATED, str(recordings))}
    )
    manifest = manifests.read((str(recordings),))
    loader = SimulatedLoader(config, manifest, tokenizer=caption_tokenizer(config, manifest))
    align, match, fields = loader.batch(0)
    assert fields is None and match.clip.shape == (8, 1, 28, 28, 3)
    place = np.asarray(match.place)
    assert list(place[:4]) == [0, 1, 2, 3] and min(place[4:]) >= 4, (
        "four simulated places, then real ones"
    )
    assert set(np.asarray(match.sensor[4:])) == {config.model.sensor_row("gelsight_mini")}
    assert np.all(np.asarray(align.text_row[4:]) == [4, 5, 6, 7]), "every real row has a caption"
    used = np.asarray(align.image_row) < 8
    assert np.asarray(align.image)[used].std() > 0
    assert not np.array_equal(match.clip[0], match.positive[0])


def test_real_partners_are_of_the_same_place_and_another_unit(recordings):
    config = tiny(2, **{"data.manifests": (SIMULATED, str(recordings))})
    real = load_real(manifests.read((str(recordings),)), config, lambda _: None)
    pairs = real.pairs[0]
    at = np.arange(len(pairs.place))
    other = np.asarray(_partners(jax.random.key(0), pairs, at))
    np.testing.assert_array_equal(np.asarray(pairs.place)[other], np.asarray(pairs.place))
    assert np.mean(np.asarray(pairs.unit)[other] != np.asarray(pairs.unit)) > 0.9
    backgrounds = np.asarray(real.gel)
    assert len(backgrounds) == 2 and np.any(np.all(backgrounds[:, 0] == 90, axis=(1, 2, 3))), (
        "one stored image, one median"
    )


def test_a_gel_moves_by_fractions_of_a_pixel_since_its_image():
    touches = SimulatedLoader(tiny()).touches(0)
    down, across = np.mgrid[:28, :28]
    ramp = np.stack([3 * across, 5 * down, 0 * down], -1).astype(np.uint8)
    behind = np.broadcast_to(ramp, (2000, 1, 28, 28, 3))
    moved = misregistered_background(jax.random.key(0), touches._replace(background=behind))
    change = (ramp - np.asarray(moved.background)[:, 0])[:, 10:-10, 10:-10, :2].mean((1, 2)) / (
        3,
        5,
    )
    np.testing.assert_allclose(change.std(0), MOVED / np.sqrt(3), rtol=0.1)
    assert np.abs(change.mean(0)).max() < 0.03 and np.abs(np.corrcoef(change.T)[0, 1]) < 0.1
    assert moved.clip is touches.clip and moved.fields is touches.fields


@pytest.mark.parametrize("mixed", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_stopped_run_continues_to_the_bit(mixed, recordings, tmp_path):
    config = tiny(**({"data.manifests": (SIMULATED, str(recordings))} if mixed else {}))
    whole = pretrain(config, tmp_path / "whole", log=lambda _: None)
    for stop in (1, 3, 4):
        parts = pretrain(config, tmp_path / "parts", stop_after=stop, log=lambda _: None)
    assert parts.step == whole.step == 4 and parts.resumed == 3
    assert_same(jax.tree.leaves(parts.params), jax.tree.leaves(whole.params))


def test_a_run_for_a_time_follows_the_time(tmp_path, monkeypatch):
    # A step looks at the clock twice, so it takes one second.
    looks = count()
    monkeypatch.setattr(pace, "time", SimpleNamespace(monotonic=lambda: 0.5 * next(looks)))
    settings = {"run.steps": 1_000_000, "run.save_every": 0, "optim.warmup": 10}
    config = tiny(**settings)
    result = pretrain(config, tmp_path / "run", log=lambda _: None, until=16.0)
    rates = [line["learning_rate"] for line in read_metrics(tmp_path / "run")]
    assert len(rates) == result.step == 17
    assert rates[0] == 0
    assert max(rates) > 0.5 * config.optim.learning_rate
    assert rates[-1] < 0.5 * max(rates)


def test_the_pressure_in_a_image_adds_up_to_the_force_in_newtons():
    """Both go through width and proportions of the image: 4:3 of a GelSight Mini, 3:4 of a DIGIT.

    The label of the simulator comes from its own grid, which is square and has no zoom.
    """
    config = tiny()
    loader = SimulatedLoader(config)
    make = jax.jit(partial(field_batch, config=config, count=8))
    shown, newtons, labels, tall = [], [], [], []
    for step in range(20):
        touches = jax.device_get(loader.touches(step))
        rows = np.asarray(touches.sensor, np.int32)
        batch = jax.device_get(make(jax.random.key(0), touches, rows))
        width, aspect, modulus = (x[:, 0] for x in (touches.width, touches.aspect, touches.modulus))
        kpa = np.asarray(touches.fields[:, 0, ..., 3], np.float64)
        pixel = width**2 * np.exp(aspect) / kpa[0].size  # mm2
        shown.append(1e-3 * kpa.sum((1, 2)) * pixel)
        newtons.append(1e-3 * batch.force[:, 2] * modulus * width**2)
        highest = kpa.max((1, 2))
        at_border = np.maximum(kpa[:, [0, -1]].max((1, 2)), kpa[:, :, [0, -1]].max((1, 2)))
        whole = (at_border < 0.02 * highest) & (highest > 0)
        labels.append(np.where(whole, touches.labels["force"][:, 0, -1], np.nan))
        tall.append(aspect > 0)
    shown, newtons, labels, tall = map(np.concatenate, (shown, newtons, labels, tall))
    np.testing.assert_allclose(newtons, shown, rtol=1e-4, atol=1e-5)
    for group in (tall, ~tall):
        inside = group & ~np.isnan(labels)
        assert inside.sum() >= 8, "enough touches whose whole contact is in the image"
        ratio = np.median(shown[inside] / labels[inside])
        assert ratio == pytest.approx(1, abs=0.07), "few pixels, so single sums are rough"
