# %% [markdown]
# # A new sensor in minutes
#
# You have twenty labelled frames of a sensor that AnyTouch was not trained on. Universal tokens serve it untrained
# (Sec. 3.5 of the paper). Does it help to fit new tokens to these frames, with everything else frozen?
#
#     anytouch adapt --run runs/stage2 --data mine.csv --sensor my_gel --labels label.material --out runs/my_gel
#     make experiments ONLY=new_sensor
#
# DuraGel is left out of training. The probes get 0, 4, 18 and 100 labelled frames of it. The dashed line is a model
# that was trained on it.

# %%
from __future__ import annotations

from experiments.tables import page, scores
from experiments.tables.results import Column, spread

runs = page.runs("new_sensor")

# %% [markdown]
# ## Picture

# %%
path = page.picture(runs)

# %% [markdown]
# ## Was there a gap?
#
# A share of a gap means something only where there is one: accuracy with nothing of the sensor, and trained on it.

# %%
for name, view in (("left_out", scores.NOTHING), ("seen", "seen")):
    for task in scores.STATIC:
        result = spread(runs, "new_sensor", name, Column(task, view, task))
        print(f"{name:9} {task:10} {'not run' if result is None else f'{result[0]:.1f} %'}")

# %% [markdown]
# ## Finding

# %%
text = page.finding("new_sensor", runs)
mine = page.yours("new_sensor", runs)
