# %% [markdown]
# # Do twenty frames of a new sensor help?
#
# Your sensor is not in the table. It gets the universal tokens. With twenty labelled frames you fit tokens for it, and
# everything else stays frozen.

# %%
import matplotlib.pyplot as plt
import numpy as np
import pyarrow.compute as pc

import anytouch_jax as at
from anytouch_jax.data.images import decode
from anytouch_jax.data.manifest.manifest import replace_column
from anytouch_jax.encoder.adapt import adapt
from anytouch_jax.encoder.embed import text_column
from anytouch_jax.weights.registry import locate
from experiments.notebooks.scenes import deepest, embed, scenes, show

table = scenes()
renamed = pc.replace_substring(table.table["sensor"].cast("string"), "duragel", "my_gel")
table = replace_column(table, "sensor", renamed)
rows = np.concatenate([deepest(table, split, most) for split, most in (("train", 60), ("test", 40))])
mine = rows[text_column(table, "sensor")[rows] == "my_gel"]
show([decode(table.file(int(row))) for row in mine[:5]], ["my_gel"] * 5, across=5)

# %% [markdown]
# ## Fit the tokens
#
# The embedding of each frame is drawn towards that of known sensors with the same label. This is what
# `anytouch adapt --frames 20` does.

# %%
fitted = adapt(locate("anytouch-tiny"), table, "my_gel", frames=20, labels="indenter", steps=40, log=lambda _: None)
plt.figure(figsize=(6, 2.6))
plt.plot(fitted.history)
plt.xlabel("step")
plt.ylabel("loss of the twenty frames")
plt.tight_layout()
plt.show()

# %% [markdown]
# ## Probe it
#
# A probe learns the indenter from frames of the known sensors, and names it on frames of `my_gel`.

# %%
universal = at.load_encoder("anytouch-tiny")
adapted = universal.__class__(fitted.config, fitted.params, "my_gel fitted")
known = text_column(table, "sensor")[rows] != "my_gel"
split = np.where(known, "train", "test")[known | (text_column(table, "split")[rows] == "test")]
rows = rows[known | (text_column(table, "split")[rows] == "test")]
labels = [table.value(int(row), "label.indenter") for row in rows]
groups = np.char.add(text_column(table, "object")[rows].astype(str), np.where(split == "test", " new", ""))
scores = {
    name: at.probe_features(embed(encoder, table, rows), labels, groups, split, seeds=0)
    for name, encoder in (("universal tokens", universal), ("fitted tokens", adapted))
}
figure, axis = plt.subplots(figsize=(5, 3))
for place, one in enumerate(scores.values()):
    axis.bar(place, 100 * one.accuracy, 0.6, color=f"C{place}")
    axis.plot([place, place], [100 * one.low, 100 * one.high], color="#222222")
axis.axhline(100 * scores["fitted tokens"].baseline, linestyle=":", color="#222222", label="the commonest answer")
axis.set_xticks(range(len(scores)), list(scores))
axis.set_ylabel("accuracy, %")
axis.legend(fontsize=8)
figure.tight_layout()
plt.show()

# %% [markdown]
# ## Finding

# %%
before, after = (100 * one.accuracy for one in scores.values())
inside = scores["universal tokens"].low <= scores["fitted tokens"].accuracy <= scores["universal tokens"].high
print(f"The tokens of twenty frames change the accuracy by {after - before:+.1f} points.")
print("That is within the interval, so it may be chance." if inside else "That is beyond the interval.")
