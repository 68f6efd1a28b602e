# %% [markdown]
# # Do twenty frames of a new sensor help?
#
# Your sensor is not in the table. It gets the universal tokens. With twenty labelled frames you fit tokens for it, and
# everything else stays frozen.

# %%
import tempfile
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pyarrow.compute as pc

import anytouch_jax as at
from anytouch_jax.data.images import decode
from anytouch_jax.data.manifest.manifest import replace_column
from anytouch_jax.encoder.adapt import adapt, save
from experiments.notebooks.scenes import deepest, embed, scenes, show, small

files = scenes()
renamed = pc.replace_substring(files.table["sensor"].cast("string"), "duragel", "my_gel")
table = replace_column(files, "sensor", renamed)
rows = np.concatenate([deepest(table, split, most) for split, most in (("train", 50), ("test", 40))])
mine = rows[table.text_column("sensor")[rows] == "my_gel"]
show([decode(table.file(int(row))) for row in mine[:5]], ["my_gel"] * 5, across=5)

# %% [markdown]
# ## An encoder that never met the sensor
#
# We train a small stage 1 on the two other sensors. You would take your own run here.

# %%
work = Path(tempfile.mkdtemp())
config = small(at.preset("tiny", stage=1), steps=40, batch=16)
config = replace(config, model=replace(config.model, sensors=("gelsight_mini", "digit", "universal")))
config = config.with_settings({"data.manifests": tuple(map(str, files.files)), "data.on_bad_sample": "skip"})
done = at.pretrain(config, work / "stage1", log=lambda _: None)
print(done.step, "steps")

# %% [markdown]
# ## Fit the tokens
#
# The embedding of each frame is drawn towards that of known sensors with the same label. This is what
# `anytouch adapt --frames 20` does.

# %%
fitted = adapt(work / "stage1", table, "my_gel", frames=20, labels="label.indenter", steps=40, log=lambda _: None)
save(fitted, work / "stage1", work / "my_gel")
plt.figure(figsize=(6, 2.6))
plt.plot(fitted.losses)
plt.xlabel("step")
plt.ylabel("loss of the twenty frames")
plt.tight_layout()
plt.show()

# %% [markdown]
# ## Probe it
#
# A probe learns the indenter from frames of the known sensors, and names it on frames of `my_gel`.

# %%
universal, adapted = at.load_encoder(work / "stage1"), at.load_encoder(work / "my_gel")
known = table.text_column("sensor")[rows] != "my_gel"
split = np.where(known, "train", "test")[known | (table.text_column("split")[rows] == "test")]
rows = rows[known | (table.text_column("split")[rows] == "test")]
labels = [table.value(int(row), "label.indenter") for row in rows]
groups = np.char.add(table.text_column("object")[rows].astype(str), np.where(split == "test", " new", ""))
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
