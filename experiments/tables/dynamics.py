# %% [markdown]
# # Does the encoder feel motion?
#
# Slip, force, the sign of a twist and the direction of a slide, from clips of three frames against the last frame
# alone, and against clips whose frames are shuffled or are the last one three times over. What a clip knows of
# *order* is lost by shuffling; what it knows of *change* is lost by repeating.
#
# **Directions and flips.** A mirrored picture of a clockwise twist shows a counter-clockwise one. Training flips
# touches (as the authors do), and the positive of a matching pair apart from its anchor, which asks the encoder to
# overlook directions. No label is destroyed here, since nothing is trained with direction labels and a probe sees
# every frame unflipped; whoever trains with such labels sets `--data.flip 0`. The row "touches never flipped" shows
# what the flips cost.
#
#     make experiments ONLY=dynamics

# %%
from __future__ import annotations

from experiments.tables import page
from experiments.tables.questions import VIEWS, dynamic
from experiments.tables.results import spread

runs = page.runs("dynamics")

# %% [markdown]
# ## Picture

# %%
path = page.picture(runs)

# %% [markdown]
# ## What order and change are worth, model by model

# %%
for name in ("anytouch", "static_only", "no_flips"):
    for number, task in enumerate(("slip", "force", "twist", "slide")):
        result = {view: spread(runs, "dynamics", name, dynamic(view)[number]) for view in VIEWS}
        if all(result.values()):
            lost = {view: result["clips"][0] - one[0] for view, one in result.items() if view != "clips"}
            print(
                f"{name:18} {task:6} clips {result['clips'][0]:.1f}",
                {view: round(one, 1) for view, one in lost.items()},
            )

# %% [markdown]
# ## Finding

# %%
text = page.finding("dynamics", runs)
mine = page.yours("dynamics", runs)
