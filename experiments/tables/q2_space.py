# %% [markdown]
# # Q2: what does the space of touches look like?
#
# The paper (Figure 4) shows a t-SNE of the same 30 touches by three sensors, for CLIP, and with masked modelling,
# alignment and cross-sensor matching added one by one. By eye: without touch, samples lie by sensor; masked modelling
# draws each sensor together; alignment begins to blend them; **matching mixes them, and they lie by touch**.
#
# A t-SNE shows what one wants to see, so numbers are given too: is the same touch by another sensor found
# among 50 (top-1, top-5), silhouettes by sensor and by object, alignment and uniformity (Wang & Isola, 2020).
#
#     make experiments ONLY=q2

# %%
from __future__ import annotations

from experiments.tables import page
from experiments.tables.questions import SPACE
from experiments.tables.results import Column, spread

runs = page.runs("q2")

# %% [markdown]
# ## Picture
#
# A mark is a sensor, a colour a touch; the same touch by three sensors is joined by dashed lines (twelve touches have
# a colour, to keep it legible). Short triangles mean that sensors agree.

# %%
path = page.picture(runs)

# %% [markdown]
# ## Class token or patches?
#
# Alignment and matching train the class token alone. The mean of the patch tokens shows what the trunk knows of it.

# %%
for view in ("class token", "patches"):
    for name in ("untrained", "masked", "aligned", "matched"):
        result = [spread(runs, "q2", name, Column(one.title, view, *one[2:])) for one in SPACE[:4]]
        cells = (f"{one.title} {value[0]:.{one.digits}f}" for one, value in zip(SPACE, result, strict=False) if value)
        print(f"{view:12} {name:10}", ", ".join(cells))

# %% [markdown]
# ## Finding

# %%
text = page.finding("q2", runs)
mine = page.yours("q2", runs)
