# %% [markdown]
# # Can ten recordings teach a classifier, and can it say "I do not know"?
#
# You have five recordings of each of two things, and later feel something else.
# The things are two indenters here. A third one plays the unknown.

# %%
import matplotlib.pyplot as plt
import numpy as np

import anytouch_jax as at
from anytouch_jax.data.images import decode
from experiments.notebooks.scenes import deepest, embed, scenes, show

table = scenes()
rows = np.concatenate([deepest(table, split, 400) for split in ("train", "val", "test")])
rows = rows[table.text_column("sensor")[rows] == "gelsight_mini"]
things = np.array([str(table.value(int(row), "label.indenter")) for row in rows])
names, counts = np.unique(things, return_counts=True)
first, second, unknown = names[np.argsort(-counts, kind="stable")][:3]
examples = [rows[things == name][0] for name in (first, second, unknown)]
show([decode(table.file(int(row))) for row in examples], [first, second, f"{unknown} (unknown)"], across=3)

# %% [markdown]
# ## Ten recordings
#
# Five of each thing are for training. All others are for the test.

# %%
encoder = at.load_encoder("anytouch-tiny")
chosen = np.concatenate([np.flatnonzero(things == name)[:15] for name in (first, second, unknown)])
features, labels = embed(encoder, table, rows[chosen]), things[chosen]
rank = np.concatenate([np.arange((labels == name).sum()) for name in (first, second, unknown)])
train = (labels != unknown) & (rank < 5)
features = (features - features[train].mean(0)) / (features[train].std(0) + 1e-6)
print(train.sum(), "recordings to learn from,", (~train).sum(), "to test")

# %% [markdown]
# ## A classifier with a limit
#
# It answers with the thing of the nearest training recording. The limit is the largest distance between a training
# recording and the nearest other one of its thing. Beyond it, the answer is "I do not know".

# %%
distance = np.linalg.norm(features[:, None] - features[None, train], axis=2)
own = np.where(labels[train][:, None] == labels[train][None], distance[train], np.inf)
np.fill_diagonal(own, np.inf)
limit = own.min(1).max()
answer = labels[train][distance.argmin(1)]
nearest = distance.min(1)
answer = np.where(nearest > limit, "I do not know", answer)

# %%
figure, axis = plt.subplots(figsize=(7, 3))
for place, name in enumerate((first, second, unknown)):
    part, right = (labels == name) & ~train, "I do not know" if name == unknown else name
    axis.scatter(nearest[part], np.full(part.sum(), place), c=["C2" if one == right else "C3" for one in answer[part]])
axis.axvline(limit, color="#222222", linestyle="--", label="limit")
axis.set_yticks(range(3), [first, second, f"{unknown} (unknown)"])
axis.set(xlabel="distance to the nearest training recording (green: a right answer)", ylim=(-0.5, 2.5))
axis.legend()
figure.tight_layout()
plt.show()

# %% [markdown]
# ## Finding

# %%
known, strange = ~train & (labels != unknown), labels == unknown
right, refused = answer == labels, answer == "I do not know"
print(f"Of {known.sum()} recordings of known things, {right[known].sum()} are named right.")
print(f"'I do not know' is the answer to {refused[known].sum()} of them.")
print(f"It is the answer to {refused[strange].sum()} of {strange.sum()} recordings of the unknown thing.")
