# %% [markdown]
# # Can you train with a loss of your own?
#
# Losses, masking and the step are pure functions of arrays. You write a training loop in forty lines, and add a loss.

# %%
import functools

import cv2
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import anytouch_jax as at
from experiments.notebooks.scenes import small

# %% [markdown]
# ## The network and the data
#
# The data are the example touches of the package, turned and mirrored. A batch is a named tuple of arrays.

# %%
BATCH, STEPS = 12, 60
config = small(at.preset("tiny", stage=1), STEPS, BATCH)
SIDE = config.model.image_size
net = at.build(config.model)
touches = at.example_touches()
pictures = np.stack([cv2.resize(touch.frame, (SIDE, SIDE)) for touch in touches])
ids = np.array([config.model.sensors.index(touch.sensor) for touch in touches], np.int32)
rng = np.random.default_rng(0)


def draw() -> at.TouchBatch:
    """Return a batch of stills u8 (B, 1, H, W, 3) with their sensor rows (B,)."""
    rows = rng.integers(len(pictures), size=BATCH)
    turned = [np.rot90(pictures[row], rng.integers(4))[:, :: rng.choice((-1, 1))] for row in rows]
    return at.TouchBatch(clip=np.stack(turned)[:, None], sensor=ids[rows])


# %% [markdown]
# ## A new loss
#
# Masked modelling leaves the class token nearly the same for every touch. We add a term that spreads it: the squared
# cosine between different touches of a batch.


# %%
def spread_loss(params, batch, key, progress, *, weight):
    """Stage 1, plus `weight` times the mean squared cosine of two touches."""
    value, metrics = at.stage1_loss(params, batch, key, progress, net=net, config=config)
    clip = batch.clip.astype(jnp.float32) / 127.5 - 1.0
    z = net.encode_touch(params, clip, batch.sensor)
    z = z / jnp.linalg.norm(z, axis=1, keepdims=True)
    alike = jnp.square(z @ z.T).sum() / len(z) ** 2
    return value + weight * alike, metrics | {"alike": alike}


# %% [markdown]
# ## The loop


# %%
def train(weight):
    """Return the metrics of each step."""
    loss = functools.partial(spread_loss, weight=weight)
    trained = functools.partial(at.trained_by, config=config)
    step = jax.jit(at.make_step(loss, at.optimizer(config), total_steps=STEPS, trained=trained))
    state = at.init_state(net.init(jax.random.key(0)), config)
    history = []
    for _ in range(STEPS):
        state, metrics = step(state, draw(), jax.random.key(1))
        history.append({name: float(value) for name, value in metrics.items()})
    return history


runs = {"stage 1 alone": train(0.0), "with the new loss": train(1.0)}

# %%
figure, axes = plt.subplots(1, 2, figsize=(9, 3))
for name, history in runs.items():
    axes[0].plot([one["reconstruction"] for one in history], label=name)
    axes[1].plot([one["alike"] for one in history], label=name)
axes[0].set(title="error of hidden patches", xlabel="step")
axes[1].set(title="squared cosine of two touches", xlabel="step", ylim=(0, None))
axes[0].legend(fontsize=8)
figure.tight_layout()
plt.show()

# %% [markdown]
# ## Finding

# %%
ends = {name: np.mean([one["alike"] for one in history[-10:]]) for name, history in runs.items()}
print("Two touches of a batch have a squared cosine of", {name: round(float(end), 2) for name, end in ends.items()})
print(
    "The new loss spreads them." if ends["with the new loss"] < ends["stage 1 alone"] else "The new loss does not help."
)
