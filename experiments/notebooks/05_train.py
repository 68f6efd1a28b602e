# %% [markdown]
# # What does training look like?
#
# You train both stages on simulated scenes, with a network small enough for minutes on a CPU, and watch them.

# %%
import tempfile
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import anytouch_jax as at
from anytouch_jax.evaluate import plots
from experiments.notebooks.scenes import scenes, show, show_file, small

table = scenes()
work = Path(tempfile.mkdtemp())
STEPS = 80


def settings(stage: int) -> at.Config:
    """Return the small configuration of a stage."""
    config = small(at.preset("tiny", stage=stage), STEPS, batch=16)
    return replace(config, data=replace(config.data, manifests=tuple(map(str, table.files))))


# %% [markdown]
# ## Stage 1: pixels
#
# Three quarters of the patches are hidden. The network paints them, and predicts the next frame of a clip.

# %%
first = at.pretrain(settings(1), work / "stage1", log=lambda sentence: None)
show_file(sorted((work / "stage1" / "figures").glob("*.png"))[-1], width=7)

# %% [markdown]
# ## Stage 2: meaning
#
# Touch, photographs and captions of one touch are drawn together. Pairs by two sensors are matched.

# %%
second = at.pretrain(settings(2), work / "stage2", init=work / "stage1", log=lambda sentence: None)
plots.loss_curves(work / "losses.png", {"stage 1": work / "stage1", "stage 2": work / "stage2"})
show_file(work / "losses.png")

# %% [markdown]
# ## What was learned
#
# The cosine of each touch with all others: red is alike, blue is not. The first three are one press by three sensors,
# the last three another. You want two red squares.

# %%
touches = at.example_touches()
pictures, titles = [], []
for name, run in (("untrained", None), ("stage 1", work / "stage1"), ("stage 2", work / "stage2")):
    encoder = at.random_encoder(settings(1), 0) if run is None else at.load_encoder(run)
    frames = np.stack([encoder.preprocess(touch.frame, touch.background) for touch in touches])
    z = encoder.encode_touch(frames, [touch.sensor for touch in touches])
    z = z - z.mean(0)
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    pictures.append(plt.get_cmap("RdBu_r")((z @ z.T + 1) / 2)[..., :3])
    titles.append(name)
show(pictures, titles, across=3, size=3)

# %% [markdown]
# ## Finding

# %%
for name in ("stage1", "stage2"):
    loss = np.array([line["loss"] for line in plots.read_metrics(work / name) if line["loss"] is not None])
    begin, end = loss[: STEPS // 8].mean(), loss[-STEPS // 8 :].mean()
    print(f"{name}: the loss went from {begin:.2f} to {end:.2f} in {len(loss)} steps.")
