"""The seed of a run decides its masks and sensor tokens, whatever its batches are."""

from functools import partial

import jax
import numpy as np
import pytest
from runs import read_metrics
from tiny_models import compiled, tiny_config

from anytouch_jax.batch import TouchBatch
from anytouch_jax.config import Stack
from anytouch_jax.objectives import stage1_loss
from anytouch_jax.train.loop import fit
from anytouch_jax.train.mesh import make_mesh

ROWS = 4
STEPS = 2


@pytest.fixture(scope="module")
def losses(tmp_path_factory):
    """losses(seed): the lines of a run of stage 1. Only the seed differs from run to run."""
    small = Stack(8, 1, 1, 8)
    config = tiny_config(touch=small, decoder=small).with_settings(
        {
            "data.batch_size": ROWS,
            "run.steps": STEPS,
            "run.save_every": 0,
            "run.figure_every": 0,
        }
    )
    net = compiled(config.model)
    side = config.model.image_size
    clip = np.random.default_rng(0).integers(0, 256, (ROWS, 1, side, side, 3), np.uint8)
    batch = TouchBatch(clip, np.zeros(ROWS, np.int32))
    loss = partial(stage1_loss, net=net.net, config=config)

    def batches(start, stop):
        for step in range(start, stop):
            yield step, batch, {}

    def run(seed):
        folder = tmp_path_factory.mktemp("run")
        fit(
            config.with_settings({"run.seed": seed}),
            params=jax.tree.map(np.array, net.params),
            loss_fn=loss,
            batches=batches,
            run_dir=folder,
            log=lambda _: None,
            mesh=make_mesh(1),
        )
        return [line["reconstruction"] for line in read_metrics(folder)]

    return run


def test_one_seed_gives_one_run_and_another_seed_another(losses):
    first, again, other = losses(0), losses(0), losses(1)
    assert len(first) == STEPS and first == again
    for step in range(STEPS):
        assert abs(first[step] - other[step]) > 1e-4 * first[step], (step, first, other)
    # The learning rate of the first step is 0, so the second begins with the same parameters.
    assert abs(first[0] - first[1]) > 1e-4 * first[0], "each step draws masks of its own"
