# %% [markdown]
# # From a download to a batch you can look at
#
# A download is a tree of folders; a **manifest** is one table with a row for each tactile frame. This page goes the
# whole way: index, look for contact, verify, pack, load. It makes its own little download, laid out like YCB-Slide
# (DIGIT, `real/<object>/dataset_<k>/frames/frame_<n>.jpg`), so it runs anywhere in seconds. With a real one, leave the
# first cell out and set `ROOT`.
#
# `FOLDER=` in the environment says where to write (default: a temporary folder).

# %%
from __future__ import annotations

import os
import tempfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from anytouch_jax.config import preset
from anytouch_jax.data.loading.loader import Loader
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.prepare.contact import contact_scores, contact_sheet, mark_contact
from anytouch_jax.data.prepare.shards import pack
from anytouch_jax.data.prepare.verify import verify
from anytouch_jax.data.readers import IndexOptions, index

FOLDER = Path(os.environ.get("FOLDER") or tempfile.mkdtemp(prefix="anytouch-"))
ROOT = FOLDER / "YCB-Slide"

# %% [markdown]
# ## A download, in small
#
# Two objects, two recordings each: the finger comes down, slides, and lifts off again.


# %%
def gel(depth: float, at: float, grain: float, seed: int) -> np.ndarray:
    """A DIGIT-like picture, BGR u8 (120, 160, 3): light from three sides, and a textured print where it is pressed."""
    y, x = np.mgrid[:120, :160].astype(np.float32)
    light = np.stack([90 + 0.5 * y, 90 + 60 * np.exp(-((x - 80) ** 2) / 4000), 150 - 0.5 * y], axis=2)
    print_ = np.exp(-((x - at) ** 2 + (y - 60) ** 2) / 900) * (1 + 0.5 * np.sin(grain * x) * np.sin(grain * y))
    slope = np.stack([np.gradient(print_, axis=0), print_ / 40, -np.gradient(print_, axis=1)], axis=2)
    noise = np.random.default_rng(seed).normal(0, 1, light.shape)
    return np.clip(light + depth * 900 * slope + noise, 0, 255).astype(np.uint8)


for thing, grain in (("mug", 0.25), ("sponge", 0.7)):
    for recording in range(2):
        frames = ROOT / "real" / thing / f"dataset_{recording}" / "frames"
        frames.mkdir(parents=True, exist_ok=True)
        for number in range(24):
            depth = np.clip(np.sin(np.pi * (number - 5) / 14), 0, 1)
            picture = gel(depth, 50 + 3 * number, grain, 100 * recording + number)
            cv2.imwrite(str(frames / f"frame_{number:07d}.jpg"), picture)

# %% [markdown]
# ## 1. Index
#
# The same as `anytouch data index ycb_slide YCB-Slide --val 0 --test 0`. It prints the counts and the paper's.

# %%
report = index("ycb_slide", ROOT, options=IndexOptions(val=0, test=0))
print("\n".join(report.lines()))
manifest = manifests.read(report.out)
manifest.table.select(["path", "sensor", "sequence", "frame_index", "split", "object"]).slice(0, 4).to_pylist()

# %% [markdown]
# ## 2. Contact
#
# `anytouch data contact ycb_slide.parquet --drop --picture contact.png`. Look at the picture: doubtful frames are at
# the border between red and green.

# %%
scores = contact_scores(manifest)
touched, contact = mark_contact(manifest, scores, drop=True)
print("\n".join(contact.lines()))
print(contact_sheet(manifest, scores, FOLDER / "contact.png"))
manifests.write(touched, ROOT / "touched.parquet")

# %% [markdown]
# ## 3. Verify
#
# `anytouch data verify touched.parquet`: every file is decoded, every rule checked. `--repair OUT` writes a clean copy.

# %%
checked = verify(manifests.read(ROOT / "touched.parquet"))
print(checked.to_markdown())
assert checked.ok

# %% [markdown]
# ## 4. Pack (for a cluster)
#
# `anytouch data pack touched.parquet --out packed`: the same bytes in a few shards; the loader reads them alike.

# %%
packed = manifests.read(pack(manifests.read(ROOT / "touched.parquet"), FOLDER / "packed"))

# %% [markdown]
# ## 5. A batch
#
# What step 1 of stage 1 holds is a function of (manifest, configuration, step): loose or packed, any number of
# threads, today or after a restart. Step 0 has stills, step 1 clips of three frames and the next one.

# %%
config = preset("tiny", stage=1)
config = replace(config, data=replace(config.data, batch_size=6))
loader, twin = Loader(manifests.read(ROOT / "touched.parquet"), config), Loader(packed, config)
for note in loader.notes:
    print(note)
still, clip = loader.batch(0), loader.batch(1)
assert all(np.array_equal(one.clip, other.clip) for one, other in ((still, twin.batch(0)), (clip, twin.batch(1))))
print("stills", still.clip.shape, "clips", clip.clip.shape, "sensor rows", clip.sensor)


# %%
def sheet(clips: np.ndarray) -> np.ndarray:
    """Clips u8 (B, T, H, W, 3) as one picture: a row a sample, a column a frame."""
    edged = np.pad(clips, ((0, 0), (0, 0), (2, 2), (2, 2), (0, 0)), constant_values=255)
    return np.vstack([np.hstack(list(frames)) for frames in edged])


cv2.imwrite(str(FOLDER / "stills.png"), sheet(still.clip)[..., ::-1])
cv2.imwrite(str(FOLDER / "clips.png"), sheet(clip.clip)[..., ::-1])
print("look at", FOLDER / "stills.png", "and", FOLDER / "clips.png")

# %% [markdown]
# Flips and colours differ from sample to sample and are the same for all frames of a clip. Now train:
#
#     make train-stage1 DATA="YCB-Slide/touched.parquet other/manifest.parquet"
