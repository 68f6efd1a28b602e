import re
from dataclasses import replace

import numpy as np
import pytest

from anytouch_jax.sim.world import objects as captions
from anytouch_jax.sim.world.objects import (
    MATERIALS,
    PRIMITIVE_KINDS,
    caption,
    catalogue,
    hardness_of,
    roughness_of,
)
from anytouch_jax.sim.world.shapes import PRIMITIVES

THINGS = catalogue(0, 300)
# What a caption would give away: kinds of primitive and things, materials, and all about the touch
# itself.
SECRET = {
    *PRIMITIVES,
    *(kind.noun for kind in PRIMITIVE_KINDS.values()),
    *MATERIALS,
    "letters",
    "bolt",
    "threaded",
    "plate",
    "sheet",
    "torus",
    "tip",
    "indenter",
    "probe",
    "sensor",
    "gel",
    "newton",
    "newtons",
    "millimetre",
    "mm",
    "turn",
    "turned",
    "clockwise",
    "left",
    "right",
    "up",
    "down",
    "upward",
    "downward",
    "above",
    "below",
    "north",
    "south",
    "east",
    "west",
    "horizontal",
    "vertical",
    "diagonal",
    "direction",
    "shear",
    "motion",
    "moving",
    "deep",
    "deeply",
    "shallow",
}
SECRET_STEMS = (
    "force",
    "press",
    "push",
    "indent",
    "depth",
    "slip",
    "slid",
    "twist",
    "rotat",
    "direction",
    "horizont",
)


def drawn(thing, count, seed=0):
    rng = np.random.default_rng([seed, thing.seed])
    return [caption(thing, rng) for _ in range(count)]


@pytest.mark.parametrize("start", range(0, 300, 60))
def test_captions_keep_what_they_must_not_tell(start):
    for thing in THINGS[start : start + 60]:
        for sentence in drawn(thing, 12, start):
            assert thing.name not in sentence.lower()
            reported = re.findall(r"[a-z]+", sentence.lower())
            assert not SECRET & set(reported), sentence
            assert not [w for w in reported if w.startswith(SECRET_STEMS)], sentence


def test_captions_tell_hardness_roughness_and_texture_rightly():
    for thing in THINGS[:80]:
        for sentence in drawn(thing, 4):
            low = sentence.lower()
            assert any(w in low for w in captions.HARDNESS[hardness_of(thing)])
            assert any(w in low for w in captions.ROUGHNESS[roughness_of(thing)])
            wide = thing.shape.texture_pitch >= captions.WIDE
            spacings = captions.SPACING["wide" if wide else "fine"]
            patterns = captions.PATTERN[thing.shape.texture]
            assert any(
                re.sub("^an ", "a ", p.format(s=s).lower()) in low
                for p in patterns
                for s in spacings
            ), sentence


def test_a_caption_does_not_know_the_form():
    """Any word for the form would tell of the indenter, whose label is never to be given away."""
    thing = THINGS[0]
    others = [replace(thing, shape=replace(thing.shape, primitive=name)) for name in PRIMITIVES]
    assert len({tuple(drawn(one, 50)) for one in others}) == 1
