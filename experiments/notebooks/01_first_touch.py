# %% [markdown]
# # Do two sensors give alike features for one press?
#
# You load an encoder, embed a few touches, look at them, and search for the nearest one.
# The package has two simulated presses, each by three sensors.

# %%
import matplotlib.pyplot as plt
import numpy as np

import anytouch_jax as at
from experiments.notebooks.scenes import show

encoder = at.load_encoder("anytouch-tiny")
touches = at.example_touches()
names = [f"{touch.press}, {touch.sensor}" for touch in touches]
show([touch.frame for touch in touches], names, across=3)

# %% [markdown]
# ## Embed
#
# `preprocess` brings a frame to the size of the encoder. It also subtracts the untouched gel, if the encoder was
# trained so.

# %%
frames = np.stack([encoder.preprocess(touch.frame, touch.background) for touch in touches])
features = encoder.encode_touch(frames, sensor=[touch.sensor for touch in touches])
print("frames", frames.shape, "features", features.shape)
show(list(frames), names, across=3)

# %% [markdown]
# ## Compare
#
# Features are compared by the cosine of their angle. We subtract the mean first: what all touches share says nothing.

# %%
centred = features - features.mean(0)
unit = centred / np.linalg.norm(centred, axis=1, keepdims=True)
cosine = unit @ unit.T
figure, axis = plt.subplots(figsize=(5.5, 4.5))
shown = axis.imshow(cosine, vmin=-1, vmax=1, cmap="RdBu_r")
axis.set_xticks(range(len(names)), names, rotation=40, ha="right", fontsize=8)
axis.set_yticks(range(len(names)), names, fontsize=8)
figure.colorbar(shown, label="cosine")
figure.tight_layout()
plt.show()

# %% [markdown]
# ## Nearest neighbours

# %%
nearest = (cosine - 3 * np.eye(len(unit))).argmax(1)
pairs = [(i, int(j)) for i, j in enumerate(nearest)]
show(
    [touches[i].frame for pair in pairs for i in pair],
    [title for i, j in pairs for title in (names[i], f"nearest: {names[j]}")],
    across=6,
)

# %% [markdown]
# ## Finding

# %%
same = sum(touches[i].press == touches[j].press for i, j in pairs)
print(f"For {same} of {len(pairs)} touches the nearest neighbour is the same press by another sensor.")
