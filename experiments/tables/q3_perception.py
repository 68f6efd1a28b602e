# %% [markdown]
# # Q3: is the unified representation better at static and dynamic perception?
#
# The paper compares AnyTouch with CLIP, UniTouch, TLV-Link (Tables 2 and 3) and, where things move, with T3 and with
# an AnyTouch that was trained on stills alone (Table 4, pouring with a robot). Here each rival is a recipe in this
# very framework (`anytouch train --baseline NAME`): the same network and data, reduced to what sets it apart. "No
# tactile pre-training" is an image tower that never met a tactile image; it is CLIP only where CLIP's weights are in
# it, and they are not here.
#
#     make experiments ONLY="q3 restricted grasp"

# %%
from __future__ import annotations

from experiments.tables import page
from experiments.tables.questions import SIX, dynamic
from experiments.tables.results import change, values
from experiments.tables.tables import title

runs = page.runs("q3")

# %% [markdown]
# ## Picture

# %%
path = page.picture(runs)

# %% [markdown]
# ## How far ahead of each rival?
#
# Mean over columns of AnyTouch minus the rival, in points. Of the dynamic tasks those with an accuracy: R2 of force is
# none.

# %%
for name in ("pixels", "untrained", "no_pretraining", "unitouch", "tlv_link", "t3", "static_only"):
    moving = [one for one in dynamic("clips") if one.metric == "accuracy"]
    for what, columns in (("static", SIX), ("dynamic", moving)):
        result = [change(values(runs, "q3", "anytouch", c), values(runs, "q3", name, c), None).mean for c in columns]
        result = [one for one in result if one is not None]
        if result:
            print(f"{title(name):40} {what:8} {sum(result) / len(result):+.1f}")

# %% [markdown]
# Raw pixels and the untrained encoder are no rivals of the paper. They say how much a number means: a task that
# pixels solve says little of an encoder.
#
# ## Finding

# %%
text = page.finding("q3", runs)
mine = page.yours("q3", runs)

# %% [markdown]
# ## The control: the same restricted data
#
# In Table 2 the paper also trains AnyTouch on the data of UniTouch alone. And it warns of Feel: with frames after the
# grasp everybody does well.

# %%
for question in ("restricted", "grasp"):
    page.finding(question, page.runs(question))
