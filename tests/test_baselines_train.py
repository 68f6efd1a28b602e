from dataclasses import replace

import numpy as np
import pytest
from runs import arrays_of, read_metrics, run_config, train
from touch_world import make_touches

from anytouch_jax.config import presets
from anytouch_jax.encoder.encoder import load_encoder

STILLS = np.random.default_rng(0).integers(0, 256, (2, 28, 28, 3), np.uint8)
EVERY = [(name, stage) for name, one in presets.BASELINES.items() for stage in one.stages]


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Two sensors at the same places, four frames each, some with RGB image and caption."""
    folder = tmp_path_factory.mktemp("touches")
    return make_touches(
        folder, touches={"train": 8}, frames=4, each=2, sensors=("digit", "gelslim")
    )


@pytest.mark.slow
@pytest.mark.parametrize(("name", "stage"), EVERY)
def test_a_baseline_trains_and_embeds(data, tmp_path, name, stage):
    config = presets.apply_baseline(name, run_config(data, stage, batch=4, steps=4))
    # The parameters of one still and one clip step are what two steps of the alternating order
    # move.
    result = train(
        replace(config, optim=replace(config.optim, warmup=1)), tmp_path / "r", stop_after=2
    )
    lines = read_metrics(tmp_path / "r")
    assert (
        all(np.isfinite(line["loss"]) and not line["skipped"] for line in lines) and len(lines) == 2
    )
    assert all(np.isfinite(array).all() for key, array in arrays_of(result).items())
    reported = set().union(*lines)
    assert ("match" in reported) == (stage == 2 and config.model.match_head != "none")
    assert ("next_frame" in reported) == (
        stage == 1 and name not in ("t3", "static_only", "no_dynamic")
    )
    if stage == 2:
        # (Every touch of this world was felt by both sensors, so that withholding those texts
        # leaves none.)
        assert ("touch_to_text" in reported) == (
            name not in ("unitouch", "no_text", "no_text_aligned")
        )
        assert ("touch_to_vision" in reported) == (name != "no_vision")
    encoder = load_encoder(tmp_path / "r")
    with pytest.warns(UserWarning, match="was not in training"):
        z = [encoder.encode_touch(STILLS, sensor) for sensor in ("digit", "duragel", "universal")]
    assert all(one.shape == (2, 12) and np.isfinite(one).all() for one in z)
    # the row of duragel is untrained
    np.testing.assert_array_equal(z[1], z[2])
    told_apart = bool(np.abs(z[0] - z[1]).max() > 0)
    # without tokens all sensors are one
    assert told_apart == (name != "tlv_link")
