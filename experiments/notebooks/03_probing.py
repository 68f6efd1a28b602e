# %% [markdown]
# # What do features contain, and how much of it did training add?
#
# A probe fits a linear head on frozen features. You compare the encoder with an untrained one and with pixels.

# %%
import matplotlib.pyplot as plt
import numpy as np

import anytouch_jax as at
from experiments.notebooks.scenes import deepest, embed, scenes, small_pictures

table = scenes()
rows = np.concatenate([deepest(table, split, most) for split, most in (("train", 90), ("val", 30), ("test", 40))])
split, objects = table.text_column("split")[rows], table.text_column("object")[rows]
encoder = at.load_encoder("anytouch-tiny")
features = {
    "anytouch-tiny": embed(encoder, table, rows),
    "untrained": embed(at.random_encoder(encoder.config, 0), table, rows),
    "pixels": small_pictures(table, rows),
}
print(len(rows), "frames of", len(set(objects)), "objects")

# %% [markdown]
# ## Two protocols
#
# The *honest* protocol chooses the penalty on validation objects. The *published* one chooses it on the test set, as
# the authors' code does. So the second is always at least as high, and says less.

# %%
results = {}
for label in ("indenter", "hardness"):
    values = [table.value(int(row), f"label.{label}") for row in rows]
    for protocol in ("honest", "published"):
        for name, x in features.items():
            results[label, protocol, name] = at.probe_features(x, values, objects, split, protocol=protocol, seeds=0)

# %%
figure, axes = plt.subplots(1, 2, figsize=(9, 3.2))
for axis, label in zip(axes, ("indenter", "hardness"), strict=True):
    for shift, protocol, colour in ((-0.2, "honest", "C0"), (0.2, "published", "#bbbbbb")):
        for place, name in enumerate(features):
            one = results[label, protocol, name]
            axis.bar(place + shift, 100 * one.accuracy, 0.4, color=colour, label=protocol if place == 0 else None)
            if one.low is not None:
                axis.plot([place + shift] * 2, [100 * one.low, 100 * one.high], color="#222222")
    axis.axhline(100 * results[label, "honest", "pixels"].baseline, linestyle=":", color="#222222")
    axis.set_xticks(range(len(features)), list(features))
    axis.set(title=f"{label} (dotted: the commonest answer)", ylabel="accuracy, %")
    axis.title.set_fontsize(9)
axes[0].legend(fontsize=8)
figure.tight_layout()
plt.show()

# %% [markdown]
# ## Finding

# %%
for label in ("indenter", "hardness"):
    ours, fresh = (100 * results[label, "honest", name].accuracy for name in ("anytouch-tiny", "untrained"))
    print(f"{label}: training changed the accuracy by {ours - fresh:+.0f} points. Chance is the dotted line.")
