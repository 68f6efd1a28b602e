# %% [markdown]
# # What do both stages know of real touch?
#
# Three models, trained on simulated scenes and on the training split of the real pack (210 ten-frame clips of a
# GelSight Mini with markers on 33 objects, and still presses by other sensors), probed on real recordings: which object
# is it, does it slip (objects left out), and which object is it on the other finger (another camera, gel and dots).
#
# **What a probe may not be given credit for.** Set-up (dots, tint) and object are partly confounded in the pack, and
# raw pixels see it; so every number is compared with raw pixels and an untrained encoder, and only a difference whose
# interval over test groups is above zero, in every seed, counts. Objects with a photograph or caption and those
# without stand apart: the first may have been named in pre-training.
#
#     make experiments ONLY=real

# %%
from __future__ import annotations

from experiments.tables import page
from experiments.tables.real import OURS, PIXELS, UNTRAINED

runs = page.runs("real")

# %% [markdown]
# ## Picture
#
# A dot a seed, with its interval over test groups (recordings; objects, where these are left out).

# %%
path = page.picture(runs)

# %% [markdown]
# ## Differences, seed by seed

# %%
for task in dict.fromkeys(row["task"] for run in runs for row in run.about["rows"]):
    for rival in (PIXELS, UNTRAINED):
        for run in runs:
            for row in run.about["rows"]:
                if (row["task"], row["view"]) == (task, f"{OURS} - {rival}") and row["low"] is not None:
                    low, mean, high = (100 * row[key] for key in ("low", "mean", "high"))
                    print(f"{task:36} less {rival:9} seed {run.seed} {mean:+6.1f} ({low:+.1f} to {high:+.1f})")

# %% [markdown]
# ## Finding

# %%
text = page.finding("real", runs)
mine = page.yours("real", runs)
