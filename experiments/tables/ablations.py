# %% [markdown]
# # Which part of AnyTouch matters?
#
# Table 6 of the paper leaves out one part at a time. All hurt, except that the stage-1-free model is 0.06 points
# better on one column. The largest loss comes from leaving out stage 2, the smallest from the text of the aligned
# set.
#
# Recipes: `anytouch train --baseline no_text` and so on. All that keep stage 1 unchanged start from the same one.
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

# %% [markdown]
# ## Picture

# %%
path = page.picture(runs)

# %% [markdown]
# ## The order of the parts
#
# By the mean loss over the four columns, next to the paper's.

# %%
order = []
for name in TABLE6:
    result = [
        change(values(runs, "ablations", name, c), values(runs, "ablations", "anytouch", c), None).mean for c in FOUR
    ]
    if name != "anytouch" and None not in result:
        paper = sum(a - b for a, b in zip(TABLE6[name], TABLE6["anytouch"], strict=True)) / len(FOUR)
        order.append((sum(result) / len(FOUR), paper, title(name)))
for ours, paper, name in sorted(order):
    print(f"{name:30} ours {ours:+.2f}   paper {paper:+.2f}")

# %% [markdown]
# ## Finding

# %%
text = page.finding("ablations", runs)
mine = page.yours("ablations", runs)
