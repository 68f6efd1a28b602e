# %% [markdown]
# # Q1: what does each sensor's data add?
#
# The paper (Table 1) trains with GelSight alone, then adds GelSlim, DIGIT and GelSight Mini, and probes on data that
# it has seen, on other data of a seen sensor, and on sensors never seen. No touch is felt by two sensors there, so
# there is no matching. Its finding: what is seen gets a little worse, as its share falls, and **unseen sensors profit
# most**.
#
# Here the same is done with simulated touch, on objects held out, with DuraGel as the sensor never seen.
#
#     make experiments ONLY=q1
#
# makes the results (some 20 minutes a seed on two slow cores); this page reads them. `RESULTS=` names another folder.

# %%
from __future__ import annotations

from itertools import pairwise

from experiments.tables import page
from experiments.tables.paper import TABLE1
from experiments.tables.questions import FOUR
from experiments.tables.results import change, values

runs = page.runs("q1")

# %% [markdown]
# ## Picture
#
# Ours in blue (left axis, interval over seeds), the paper's numbers in grey (right axis): the direction is to be
# compared, not the height.

# %%
path = page.picture(runs)

# %% [markdown]
# ## Each step by itself
#
# What a sensor adds to the two columns of the unseen sensor, and what it added in the paper (percentage points).

# %%
names = list(TABLE1)
for before, after in pairwise(names[1:]):
    ours = [change(values(runs, "q1", after, one), values(runs, "q1", before, one), None).mean for one in FOUR[2:]]
    paper = [round(a - b, 2) for a, b in zip(TABLE1[after][2:], TABLE1[before][2:], strict=True)]
    print(
        f"+ {after.split('+')[-1]:14}", "ours", [None if one is None else round(one, 2) for one in ours], "paper", paper
    )

# %% [markdown]
# ## Finding
#
# The table, and of every row whether its sign agrees with the paper's.

# %%
text = page.finding("q1", runs)
mine = page.yours("q1", runs)
