# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # A new sensor in minutes
#
# You have twenty frames of a sensor that AnyTouch never saw. Universal tokens serve it as they are (Sec. 3.5 of the
# paper). Does it help to fit tokens of its own, with everything else frozen, and do labels of these frames help more?
#
#     anytouch adapt --run runs/stage1 --data mine.csv --sensor my_gel --frames 18 --out runs/my_gel
#     make experiments ONLY=new_sensor
#
# DuraGel is left out of training. 0, 4, 18 and 100 of its frames are given, with or without labels; the dashed line
# is a model that was trained on it.

# %%
from __future__ import annotations

from experiments.tables import adaptation, page
from experiments.tables.results import Column, spread

runs = page.runs("new_sensor")
print(len(runs), "runs,", len({run.seed for run in runs}), "seeds")

# %% [markdown]
# ## Picture

# %%
path = page.picture(runs)

# %% [markdown]
# ## Was there a gap?
#
# A share of a gap means something only where there is one: accuracy with nothing of the sensor, and trained on it.

# %%
for name, view in (("left_out", "universal, 0 unlabelled"), ("seen", "seen")):
    for task in adaptation.TASKS:
        found = spread(runs, "new_sensor", name, Column(task, view, task))
        print(f"{name:9} {task:10} {'not run' if found is None else f'{found[0]:.1f} %'}")

# %% [markdown]
# ## A checkpoint of yours
#
# `RUN=` names a run, `DATA=` the folder of the data sets (default: runs/matrix, made where they are not there): it is
# scored as above, in minutes on a CPU, and stands beside our rows.

# %%
mine = page.yours("new_sensor", runs)

# %% [markdown]
# ## Finding

# %%
text = page.finding("new_sensor", runs)
