import multiprocessing
import pickle
import time
import warnings
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_models import full_model, tiny_config

from anytouch_jax.config import Config
from anytouch_jax.encoder import base
from anytouch_jax.encoder.base import Preprocess
from anytouch_jax.encoder.encoder import Encoder, load_encoder, random_encoder
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.heads import GradientRecipe, ProbeHead, fit_head
from anytouch_jax.evaluate.reconstruction import reconstruction_panels
from anytouch_jax.export.export import export, load
from anytouch_jax.nn.functional import build
from anytouch_jax.sim.recorder import simulate_touch
from anytouch_jax.train.loop import fit
from anytouch_jax.train.optim import optimizer
from anytouch_jax.train.step import init_state, make_step
from anytouch_jax.training import pretrain

RNG = np.random.default_rng(0)
FRAMES = RNG.integers(0, 256, (70, 1, 28, 28, 3), np.uint8)
GOLDEN = Path(__file__).parents[1] / "parity" / "golden_others"
IMAGE = RNG.integers(0, 256, (40, 30, 3), np.uint8)


@pytest.fixture(scope="module")
def workers(tmp_path_factory):
    """What users send to workers, by name: the object, and a function of it that computes."""
    folder = tmp_path_factory.mktemp("workers")
    config = Config(full_model())
    params = build(config.model).init(jax.random.key(0))
    touch = {"touch": params.pop("touch")}
    encoder = Encoder(base.touch_only(config), touch, "mine", whole=config.model, others=params)
    export(encoder, folder / "touch.bin", platforms=("cpu",))
    export(encoder, folder / "touch.onnx", form="onnx")
    other = load_encoder(GOLDEN / "timm_vit.safetensors", heads=4)
    return {
        "encoder": (encoder, lambda one: one.encode_touch(FRAMES[:3], "digit")),
        "towers": (encoder, lambda one: one.encode_image([IMAGE, IMAGE])),
        "match": (encoder, lambda one: one.match(np.ones((3, 12)), np.ones((3, 12)))),
        "family": (other, lambda one: one.encode_touch(np.stack([one.preprocess(IMAGE)] * 3))),
        "preprocess": (Preprocess(encoder, IMAGE), lambda one: one(IMAGE)),
        "preprocess of a family": (Preprocess(other), lambda one: one(IMAGE)),
        "preprocess of an engine": (
            Preprocess(load_encoder(folder / "touch.onnx")),
            lambda one: one(IMAGE),
        ),
        "exported": (load(folder / "touch.bin"), lambda one: one(FRAMES[:3])),
        "engine": (load_encoder(folder / "touch.onnx"), lambda one: one.encode_touch(FRAMES[:3])),
        "the folder": (folder, lambda one: load_encoder(one / "touch.onnx")),
    }


def programs():
    """What else computes, by name."""
    config = tiny_config(1)
    params = build(config.model).init(jax.random.key(0))
    x = RNG.standard_normal((20, 4)).astype("f4")
    y = np.arange(20) % 3
    state = init_state(params, config)
    tx = optimizer(config)
    key = jax.random.key(0)
    jitted = jax.jit(lambda x: x + 1)
    step = make_step(lambda *_: (jnp.zeros(()), {}), tx, total_steps=2)
    return {
        "head by gradients": lambda: fit_head(
            ProbeHead("gradient", (1,), recipe=GradientRecipe(1)), x, y, 3
        ),
        "first state": lambda: init_state(params, config),
        "step": lambda: step(state, (), key),
        "fit": lambda: fit(config, params=params, loss_fn=None, batches=None, run_dir="."),
        "pretrain": lambda: pretrain(config, "."),
        "simulated touch": lambda: simulate_touch(np.zeros((9, 9)), np.zeros(4)),
        "panels": lambda: reconstruction_panels(
            params, None, None, net=build(config.model), config=config
        ),
        "your own program": lambda: jitted(np.ones(3)),
    }


NAMES = (
    "encoder",
    "towers",
    "match",
    "family",
    "preprocess",
    "preprocess of a family",
    "preprocess of an engine",
    "exported",
    "engine",
)


@pytest.mark.parametrize("name", NAMES)
def test_pickle_holds_the_same_before_and_after_the_first_call(workers, name):
    one, use = workers[name]
    fresh = pickle.dumps(pickle.loads(pickle.dumps(one)))
    wanted = use(one)
    # compiled programs are not state
    assert abs(len(pickle.dumps(one)) - len(fresh)) < 100
    np.testing.assert_array_equal(use(pickle.loads(pickle.dumps(one))), wanted)
    if "preprocess" in name:
        # no parameters go to a worker that prepares frames
        assert len(fresh) < 10_000


def test_a_forked_process_computes_or_says_why_it_cannot(workers):
    calls = {name: partial(use, one) for name, (one, use) in workers.items()}
    for call in calls.values():
        call()  # jax runs in this process
    calls |= programs()

    def answers(pipe) -> None:
        for call in calls.values():
            begin = time.monotonic()
            try:
                answer = str(call().shape)
            except (UserError, RuntimeError) as error:
                answer = str(error)
            pipe.send((answer, time.monotonic() - begin))

    fork = multiprocessing.get_context("fork")
    ours, theirs = fork.Pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # jax and Python warn of forks
        child = fork.Process(target=answers, args=(theirs,))
        child.start()
    try:
        for name in calls:
            assert ours.poll(30), f"{name} hangs"
            answer, seconds = ours.recv()
            if name == "engine" or "preprocess" in name:
                assert answer.startswith("("), name
            elif name == "your own program":
                # jax's word: it does not hang
                assert "tracing" in answer and seconds < 1
            else:
                assert "forked" in answer and "spawn" in answer and seconds < 1, (name, answer)
    finally:
        child.kill()
        child.join()


@pytest.mark.parametrize("part", ["touch", "image", "text", "match", "exported"])
def test_few_numbers_of_rows_are_compiled_and_features_are_equal(workers, part, monkeypatch):
    encoder = workers["encoder"][0]
    exported = workers["exported"][0]
    encoder = pickle.loads(pickle.dumps(encoder))
    shapes = set()

    def ids(texts, length):
        return np.array([[int(one) % 9] * length for one in texts]), np.ones(
            (len(texts), length), bool
        )

    words = SimpleNamespace(vocab_size=9, encode=ids)
    encoder.__dict__["tokenizer"] = words
    images = RNG.integers(0, 256, (70, 28, 28, 3), np.uint8)
    z = RNG.standard_normal((2, 70, 12))
    run = {
        "touch": lambda n: encoder.encode_touch(FRAMES[:n], np.arange(n) % 3),
        "image": lambda n: encoder.encode_image(list(images[:n])),
        "text": lambda n: encoder.encode_text([str(i) for i in range(n)]),
        "match": lambda n: encoder.match(z[0, :n], z[1, :n]),
        "exported": lambda n: exported(FRAMES[:n], np.arange(n) % 3),
    }[part]
    plain = jax.jit

    def counting(function, *args, **kwargs):
        def traced(*given):
            shapes.add(
                tuple(
                    x.shape[0]
                    for x in jax.tree.leaves(given[1:] if part == "touch" else given[-1:])
                )
            )
            return function(*given)

        return plain(traced, *args, **kwargs)

    monkeypatch.setattr(jax, "jit", counting)
    exported.__dict__.pop("_running", None)
    whole = run(70)
    assert len(whole) == 70
    for count in (*range(1, 23), 33, 65):
        np.testing.assert_allclose(run(count), whole[:count], atol=1e-5)
    assert len(shapes) <= 8  # 1, 2, 4, ... 64, 128


def test_touches_of_two_numbers_do_not_match(workers):
    with pytest.raises(UserError, match="one shape"):
        workers["encoder"][0].match(np.ones((3, 12)), np.ones((4, 12)))
    assert random_encoder(Config(full_model())).encode_touch(FRAMES[:0]).shape == (0, 12)
