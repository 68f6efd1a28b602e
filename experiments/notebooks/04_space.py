# %% [markdown]
# # Are touches ordered by sensor or by object?
#
# Figure 4 of the paper shows a t-SNE of the same touches by several sensors. You draw it for three sets of features.

# %%
import tempfile
from pathlib import Path

import anytouch_jax as at
from anytouch_jax.evaluate import geometry, plots
from experiments.notebooks.scenes import deepest, embed, scenes, show_file, small_pictures

table = scenes()
rows = deepest(table, "test", 30)
sensors, objects = table.text_column("sensor")[rows], table.text_column("object")[rows]
touches = table.text_column("touch")[rows]
encoder = at.load_encoder("anytouch-tiny")
spaces = {
    "pixels": small_pictures(table, rows),
    "untrained": embed(at.random_encoder(encoder.config, 0), table, rows),
    "anytouch-tiny": embed(encoder, table, rows),
}
print(len(rows), "touches by", ", ".join(sorted(set(sensors))))

# %% [markdown]
# ## The picture
#
# The upper row is coloured by sensor, the lower one by object. Clusters of one colour in the upper row mean that the
# space is ordered by sensor. In the lower row they mean that it is ordered by object.

# %%
path = Path(tempfile.mkdtemp()) / "space.png"
plots.tsne_panels(path, {name: geometry.tsne(x) for name, x in spaces.items()}, sensors, objects)
show_file(path)

# %% [markdown]
# ## In numbers
#
# A t-SNE shows what you want to see. Silhouettes are measured in the full space: near one is ordered, near zero mixed.

# %%
scores = {name: geometry.describe(x, sensors, objects, touches, name=name) for name, x in spaces.items()}
for name, one in scores.items():
    print(f"{name:14} by sensor {one.silhouette_sensor:+.3f}   by object {one.silhouette_object:+.3f}")

# %% [markdown]
# ## Finding

# %%
ours = scores["anytouch-tiny"]
order = {"sensor": ours.silhouette_sensor, "object": ours.silhouette_object}
best = max(order, key=lambda name: order[name])
ordered = f"by {best}" if order[best] > 0.1 else "neither by sensor nor by object"
mixed = min(scores, key=lambda name: abs(scores[name].silhouette_sensor))
print(f"The features of anytouch-tiny are ordered {ordered}. Sensors are mixed best in: {mixed}.")
