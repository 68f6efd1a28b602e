"""Objects to touch: a catalogue of nameable ones drawn from a seed, their labels, and hold-outs by kind."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from anytouch_jax.errors import UserError
from anytouch_jax.sim.world.materials import MATERIALS, Material, hardness_class
from anytouch_jax.sim.world.primitives import PRIMITIVES, STROKES
from anytouch_jax.sim.world.shapes import Shape
from anytouch_jax.sim.world.textures import TEXTURES

# Sizes in mm (see `Shape`): contacts of 0.2 to 1.2 mm fill a good part of a field of 12 to 19 mm.
SIZES: dict[str, tuple[float, float]] = {
    "sphere": (5.0, 12.0),
    "cylinder": (4.0, 11.0),
    "edge": (0.5, 2.5),
    "corner": (0.5, 2.5),
    "cone": (3.5, 8.0),
    "ring": (4.0, 6.5),
    "flat": (4.5, 11.0),
    "screw": (3.5, 7.0),
    "letters": (7.0, 12.0),
}
# Pitch in mm; for random textures the size of a bump.
PITCHES: dict[str, tuple[float, float]] = {
    "smooth": (1.0, 1.0),
    "weave": (1.2, 2.6),
    "knit": (1.6, 3.0),
    "ridges": (0.9, 2.6),
    "grid": (1.5, 3.0),
    "dots": (1.2, 2.8),
    "bark": (1.5, 3.0),
    "sand": (0.9, 2.2),
}
# RMS slope of a texture whose depth equals its pitch, measured on the height maps; tests hold them to that.
SLOPES = {
    "smooth": 0.0,
    "weave": 1.4,
    "knit": 3.7,
    "ridges": 2.5,
    "grid": 3.0,
    "dots": 2.15,
    "bark": 1.85,
    "sand": 1.65,
}
STEEPNESS = (0.15, 0.5)  # the RMS slope that an object's texture draws: visible, and a gel can follow
ROUGH = 0.32  # the RMS slope from which a texture is called rough
DEPTHS = (0.1, 0.5)  # mm
# Small contacts and raised figures carry only textures that neither swallows; all others go with everything.
FITTING: dict[str, tuple[str, ...]] = {
    "cone": ("smooth", "bark", "sand", "ridges"),
    "screw": ("smooth", "sand", "bark"),
    "letters": ("smooth", "sand", "weave", "ridges"),
    "ring": ("smooth", "sand", "weave", "dots", "ridges", "knit"),
}
NOUNS = {
    "sphere": "ball",
    "cylinder": "rod",
    "edge": "edge",
    "corner": "corner",
    "cone": "cone",
    "ring": "ring",
    "flat": "disc",
    "screw": "screw",
    "letters": "letter",
}
ADJECTIVES = {
    "smooth": "smooth",
    "weave": "woven",
    "knit": "knitted",
    "ridges": "ribbed",
    "grid": "waffled",
    "dots": "dotted",
    "bark": "furrowed",
    "sand": "sandy",
}
Pair = tuple[str, str]


@dataclass(frozen=True)
class Object:
    """A nameable thing: its surface, its material, its colour RGB 0..1, and the seed of its looks."""

    name: str
    shape: Shape
    material: Material
    colour: tuple[float, float, float]
    seed: int

    @property
    def kind(self) -> Pair:
        """(primitive, texture): what a hold-out keeps together."""
        return self.shape.primitive, self.shape.texture


def combinations() -> list[tuple[str, str, str]]:
    """Every sensible (primitive, texture, material), in a fixed order."""
    return [
        (primitive, texture, material.name)
        for primitive in PRIMITIVES
        for texture in FITTING.get(primitive, tuple(TEXTURES))
        for material in MATERIALS.values()
        if texture in material.textures
    ]


def catalogue(seed: int, count: int = 64) -> tuple[Object, ...]:
    """`count` objects with different names, the same for a seed; a smaller count gives the first of a larger one.

    No combination of primitive, texture and material comes twice. What was drawn least so far comes next, so that
    primitives, textures, materials and their pairs stay even. Raises UserError for a count below 1 or above the
    combinations.
    """
    left = combinations()
    if not 1 <= count <= len(left):
        raise UserError(f"the catalogue holds 1 to {len(left)} objects, not {count}")
    rng = np.random.default_rng([seed, 64])
    left = [left[i] for i in rng.permutation(len(left))]
    used: Counter[object] = Counter()
    objects = []
    for _ in range(count):
        chosen = min(left, key=lambda c: 3 * used[c[:2]] + used[c[1:]] + sum(used[kind] for kind in c))
        left.remove(chosen)
        used.update([chosen[:2], chosen[1:], *chosen])
        objects.append(draw_object(*chosen, seed=int(rng.integers(2**31))))
    return tuple(objects)


def draw_object(primitive: str, texture: str, material: str, seed: int) -> Object:
    """One object of this kind with sizes, phases and colour from `seed`.

    Raises UserError on a name that is not in PRIMITIVES, TEXTURES or MATERIALS.
    """
    for name, table in ((primitive, PRIMITIVES), (texture, TEXTURES), (material, MATERIALS)):
        if name not in table:
            raise UserError(f"there is no {name!r} to make an object of; choose one of {', '.join(table)}")
    rng = np.random.default_rng([seed, 11])
    made_of = MATERIALS[material]
    pitch = float(rng.uniform(*PITCHES[texture]))
    if primitive in ("letters", "cone", "ring"):  # small contacts: finer textures
        pitch = PITCHES[texture][0] + 0.4 * (pitch - PITCHES[texture][0])
    steepness = float(rng.uniform(*STEEPNESS))
    depth = min(max(steepness * pitch / max(SLOPES[texture], 1.0), DEPTHS[0]), DEPTHS[1])
    if primitive == "letters":  # the stroke must stand out
        depth = min(depth, 0.18)
    letter = sorted(STROKES)[int(rng.integers(len(STROKES)))]
    grain_scale = float(rng.uniform(0.85, 1.2))
    shape = Shape(
        primitive=primitive,
        texture=texture,
        size=round(float(rng.uniform(*SIZES[primitive])), 3),
        texture_pitch=round(pitch, 3),
        texture_depth=0.0 if texture == "smooth" else round(depth, 3),
        seed=int(rng.integers(2**20)),
        texture_angle=round(float(rng.uniform(0, math.pi)), 4),
        irregularity=made_of.irregularity,
        grain=made_of.grain,
        grain_pitch=round(made_of.grain_pitch * grain_scale, 3),
        grain_depth=made_of.grain_depth,
        letter=letter,
    )
    tints = (made_of.colour, *made_of.tints)
    tint = np.asarray(tints[int(rng.integers(len(tints)))])
    colour = np.clip(tint * rng.uniform(0.85, 1.15) + rng.uniform(-0.03, 0.03, 3), 0.02, 0.95)
    noun = f"{NOUNS[primitive]} {letter}" if primitive == "letters" else NOUNS[primitive]
    red, green, blue = (round(float(c), 4) for c in colour)
    return Object(f"{ADJECTIVES[texture]} {material} {noun}", shape, made_of, (red, green, blue), seed)


def hold_out(objects: Sequence[Object], share: float, seed: int) -> tuple[tuple[Object, ...], tuple[Object, ...]]:
    """Split into (seen, unseen) so that no (primitive, texture) of an unseen object is among the seen ones.

    At least `share` of the objects are unseen, by as few as the pairs allow, and every primitive and every texture
    that the objects have is still among the seen ones. Order is kept. Raises UserError when that cannot be done.
    """
    if not 0 < share < 1:
        raise UserError(f"the share of objects held out must lie between 0 and 1, not {share}")
    pairs = sorted({o.kind for o in objects})
    sizes = Counter(o.kind for o in objects)
    primitives, textures = Counter(p for p, _ in pairs), Counter(t for _, t in pairs)
    unseen: set[Pair] = set()
    held = 0
    for i in np.random.default_rng([seed, 12]).permutation(len(pairs)):
        if held >= share * len(objects):
            break
        primitive, texture = pairs[i]
        if primitives[primitive] > 1 and textures[texture] > 1:
            unseen.add(pairs[i])
            primitives[primitive] -= 1
            textures[texture] -= 1
            held += sizes[pairs[i]]
    if held < share * len(objects):
        raise UserError(
            f"of {len(objects)} objects only {held} can be held out without losing a primitive or a texture; "
            f"ask for less than {share:g} of them or draw more objects"
        )
    seen = tuple(o for o in objects if o.kind not in unseen)
    return seen, tuple(o for o in objects if o.kind in unseen)


def hardness_of(thing: Object) -> str:
    """ "soft", "firm" or "hard"."""
    return hardness_class(thing.material.modulus)


def roughness_of(thing: Object) -> str:
    """ "smooth", "textured" or "rough", by the RMS slope of the texture."""
    shape = thing.shape
    slope = SLOPES[shape.texture] * shape.texture_depth / shape.texture_pitch
    return "smooth" if slope == 0 else "textured" if slope < ROUGH else "rough"
