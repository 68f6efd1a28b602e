# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # Which part of AnyTouch matters?
#
# Table 6 of the paper leaves out one part at a time. All hurt, except that the stage-1-free model is 0.06 points
# better on one column. The largest loss comes from leaving out stage 2, the smallest from the text of the aligned
# set.
#
# Recipes: `anytouch train --baseline no_text` and so on. All that keep stage 1 as it is start from one and the same.
#
#     make experiments ONLY=ablations

# %%
from __future__ import annotations

from experiments.tables import page
from experiments.tables.paper import TABLE6
from experiments.tables.questions import FOUR
from experiments.tables.results import change, values
from experiments.tables.tables import title

runs = page.runs("ablations")
print(len(runs), "runs,", len({run.seed for run in runs}), "seeds")

# %% [markdown]
# ## Picture

# %%
path = page.picture(runs)

# %% [markdown]
# ## The order of the parts
#
# By the mean loss over the four columns, beside the paper's.

# %%
order = []
for name in TABLE6:
    found = [
        change(values(runs, "ablations", name, c), values(runs, "ablations", "anytouch", c), None).mean for c in FOUR
    ]
    if name != "anytouch" and None not in found:
        paper = sum(a - b for a, b in zip(TABLE6[name], TABLE6["anytouch"], strict=True)) / len(FOUR)
        order.append((sum(found) / len(FOUR), paper, title(name)))
for ours, paper, name in sorted(order):
    print(f"{name:30} ours {ours:+.2f}   paper {paper:+.2f}")

# %% [markdown]
# ## A checkpoint of yours
#
# `RUN=` names a run, `DATA=` the folder of the data sets (default: runs/matrix, made where they are not there): it is
# scored as above, in minutes on a CPU, and compared with our rows.

# %%
mine = page.yours("ablations", runs)

# %% [markdown]
# ## Finding

# %%
text = page.finding("ablations", runs)
