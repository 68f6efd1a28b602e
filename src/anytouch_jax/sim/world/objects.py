"""Objects to touch: materials, a catalogue from a seed, held-out kinds, labels and captions."""

import math
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from anytouch_jax.errors import UserError
from anytouch_jax.sim.world.shapes import PRIMITIVES, STROKES, TEXTURES, Shape

# In kPa: a finger dents softer materials, and a hand cannot deform harder ones.
SOFT = 400.0
HARD = 50_000.0


@dataclass(frozen=True)
class Material:
    """A material: mechanics, look, and words."""

    name: str
    modulus: float  # kPa, effective near the surface
    friction: float  # against a silicone gel
    colour: tuple[float, float, float]  # RGB 0..1
    gloss: float  # strength of highlights, 0..1
    grain: str  # fine structure
    grain_pitch: float  # mm
    grain_depth: float  # mm
    irregularity: float  # of its patterns, in pitches
    textures: tuple[str, ...]  # that objects of it have
    feel: tuple[str, ...]  # phrases for warmth and grip
    tints: tuple[tuple[float, float, float], ...] = ()  # other usual colours
    metallic: bool = False  # highlights have its colour
    mottle: float = 0.1  # unevenness of its colour, 0..1


MATERIALS: dict[str, Material] = {
    m.name: m
    for m in (
        Material(
            "rubber",
            1_500.0,
            1.0,
            (0.13, 0.13, 0.14),
            0.25,
            "none",
            0.8,
            0.0,
            0.02,
            ("smooth", "ridges", "grid", "dots", "knit", "sand"),
            ("grippy", "clinging to the skin", "dry and grippy"),
            ((0.55, 0.12, 0.1), (0.12, 0.25, 0.5)),
        ),
        Material(
            "silicone",
            250.0,
            1.1,
            (0.55, 0.75, 0.72),
            0.45,
            "none",
            0.8,
            0.0,
            0.03,
            ("smooth", "dots", "grid", "ridges", "knit", "weave"),
            ("slightly tacky", "skin-like", "tacky and supple"),
            ((0.85, 0.45, 0.5), (0.85, 0.8, 0.72), (0.4, 0.6, 0.35)),
        ),
        Material(
            "foam",
            60.0,
            0.9,
            (0.9, 0.82, 0.4),
            0.0,
            "pores",
            0.9,
            0.07,
            0.05,
            ("smooth", "dots", "ridges", "grid", "sand"),
            ("warm and porous", "airy", "light and porous"),
            ((0.35, 0.36, 0.4), (0.5, 0.7, 0.8)),
        ),
        Material(
            "fabric",
            120.0,
            0.55,
            (0.25, 0.33, 0.55),
            0.0,
            "threads",
            0.65,
            0.03,
            0.12,
            ("smooth", "weave", "knit", "ridges", "dots"),
            ("warm and dry", "fuzzy", "warm with loose fibres"),
            ((0.6, 0.2, 0.22), (0.75, 0.7, 0.6), (0.3, 0.42, 0.3)),
            mottle=0.2,
        ),
        Material(
            "leather",
            5_000.0,
            0.65,
            (0.4, 0.23, 0.13),
            0.25,
            "pebbles",
            0.8,
            0.045,
            0.08,
            ("smooth", "bark", "weave", "dots", "sand", "ridges"),
            ("warm and supple", "finely creased", "dry and warm"),
            ((0.15, 0.11, 0.1), (0.6, 0.4, 0.22)),
            mottle=0.25,
        ),
        Material(
            "cork",
            9_000.0,
            0.75,
            (0.72, 0.53, 0.34),
            0.02,
            "pores",
            0.7,
            0.05,
            0.08,
            ("smooth", "bark", "sand", "grid", "ridges"),
            ("warm and light", "warm and slightly crumbly", "dry and warm"),
            mottle=0.7,
        ),
        Material(
            "wood",
            1.0e7,
            0.45,
            (0.62, 0.43, 0.26),
            0.12,
            "streaks",
            0.8,
            0.04,
            0.05,
            ("smooth", "bark", "ridges", "grid", "weave", "sand"),
            ("neither warm nor cold", "dry and fibrous", "dry with a fine grain"),
            ((0.42, 0.26, 0.15), (0.78, 0.63, 0.43)),
            mottle=0.6,
        ),
        Material(
            "plastic",
            2.2e6,
            0.4,
            (0.82, 0.82, 0.8),
            0.5,
            "none",
            0.8,
            0.0,
            0.0,
            ("smooth", "grid", "dots", "ridges", "weave", "sand", "knit"),
            ("neutral in warmth", "light and dry", "slick and dry"),
            ((0.75, 0.15, 0.12), (0.12, 0.35, 0.65), (0.9, 0.65, 0.1), (0.15, 0.16, 0.17)),
        ),
        Material(
            "ceramic",
            2.0e8,
            0.3,
            (0.88, 0.85, 0.79),
            0.75,
            "none",
            0.8,
            0.0,
            0.04,
            ("smooth", "ridges", "dots", "bark", "weave", "sand"),
            ("cool", "cool and glazed", "cool and slick"),
            ((0.25, 0.4, 0.5), (0.65, 0.33, 0.22)),
        ),
        Material(
            "glass",
            7.0e7,
            0.25,
            (0.5, 0.66, 0.64),
            1.0,
            "none",
            0.8,
            0.0,
            0.02,
            ("smooth", "ridges", "dots", "grid", "bark"),
            ("cold and slick", "cold", "cool and flawless"),
            ((0.24, 0.42, 0.3), (0.45, 0.3, 0.15)),
            mottle=0.0,
        ),
        Material(
            "steel",
            2.0e8,
            0.3,
            (0.6, 0.61, 0.63),
            0.9,
            "streaks",
            0.9,
            0.012,
            0.01,
            ("smooth", "grid", "dots", "ridges", "weave", "knit", "sand"),
            ("cold", "cold and unyielding", "cold and slick"),
            ((0.68, 0.56, 0.35),),
            metallic=True,
            mottle=0.05,
        ),
        Material(
            "stone",
            5.0e7,
            0.55,
            (0.52, 0.5, 0.47),
            0.05,
            "grit",
            0.9,
            0.06,
            0.06,
            ("smooth", "sand", "bark", "grid", "ridges"),
            ("cold and dry", "cool and gritty", "cool and mineral"),
            ((0.35, 0.34, 0.34), (0.68, 0.58, 0.47)),
            mottle=0.8,
        ),
    )
}


class PrimitiveKind(NamedTuple):
    """What objects of a primitive are like."""

    noun: str
    size: tuple[float, float]  # mm, range of sizes (see `Shape`)
    textures: tuple[str, ...] = tuple(TEXTURES)  # that fit it


class TextureKind(NamedTuple):
    """What objects with a texture are like."""

    adjective: str
    pitch: tuple[float, float]  # mm, range of pitches
    slope: float  # RMS, if its depth equals its pitch


# Contacts of 0.2 to 1.2 mm fill a good part of a field of 12 to 19 mm. Small contacts and raised
# figures have only textures that do not hide them and are not hidden by them.
PRIMITIVE_KINDS = {
    "sphere": PrimitiveKind("ball", (5.0, 12.0)),
    "cylinder": PrimitiveKind("rod", (4.0, 11.0)),
    "edge": PrimitiveKind("edge", (0.5, 2.5)),
    "corner": PrimitiveKind("corner", (0.5, 2.5)),
    "cone": PrimitiveKind("cone", (3.5, 8.0), ("smooth", "bark", "sand", "ridges")),
    "ring": PrimitiveKind(
        "ring", (4.0, 6.5), ("smooth", "sand", "weave", "dots", "ridges", "knit")
    ),
    "flat": PrimitiveKind("disc", (4.5, 11.0)),
    "screw": PrimitiveKind("screw", (3.5, 7.0), ("smooth", "sand", "bark")),
    "letters": PrimitiveKind("letter", (7.0, 12.0), ("smooth", "sand", "weave", "ridges")),
}
TEXTURE_KINDS = {  # slopes are measured on the height maps, and a test repeats the measurement
    "smooth": TextureKind("smooth", (1.0, 1.0), 0.0),
    "weave": TextureKind("woven", (1.2, 2.6), 1.4),
    "knit": TextureKind("knitted", (1.6, 3.0), 3.7),
    "ridges": TextureKind("ribbed", (0.9, 2.6), 2.5),
    "grid": TextureKind("waffled", (1.5, 3.0), 3.0),
    "dots": TextureKind("dotted", (1.2, 2.8), 2.15),
    "bark": TextureKind("furrowed", (1.5, 3.0), 1.85),
    "sand": TextureKind("sandy", (0.9, 2.2), 1.65),
}
_STEEPNESS = (0.15, 0.5)  # RMS slope of an object's texture: visible, and a gel can follow it
_ROUGH = 0.32  # RMS slope from which a texture is called rough
_DEPTHS = (0.1, 0.5)  # mm
Pair = tuple[str, str]


@dataclass(frozen=True)
class Object:
    """An object: its name, surface, material, colour RGB 0..1, and seed."""

    name: str
    shape: Shape
    material: Material
    colour: tuple[float, float, float]
    seed: int

    @property
    def kind(self) -> Pair:
        """(primitive, texture), which is held out as a whole."""
        return self.shape.primitive, self.shape.texture


def combinations() -> list[tuple[str, str, str]]:
    """Return every sensible (primitive, texture, material) in a fixed order."""
    return [
        (primitive, texture, material.name)
        for primitive in PRIMITIVES
        for texture in PRIMITIVE_KINDS[primitive].textures
        for material in MATERIALS.values()
        if texture in material.textures
    ]


def catalogue(seed: int, count: int = 64) -> tuple[Object, ...]:
    """Return `count` objects with different names.

    A smaller count returns the first objects of a larger one. No combination is repeated, and the
    least drawn one so far comes next. Raises UserError for a bad count.
    """
    left = combinations()
    if not 1 <= count <= len(left):
        raise UserError(f"the catalogue holds 1 to {len(left)} objects, not {count}")
    rng = np.random.default_rng([seed, 64])
    left = [left[i] for i in rng.permutation(len(left))]
    used: Counter[object] = Counter()

    def often(one: tuple[str, str, str]) -> int:
        """Return how often the parts of a combination were drawn."""
        primitive, texture, material = one
        # Pairs of primitive and texture weigh most, because they are held out as a whole.
        pairs = 3 * used[primitive, texture] + used[texture, material]
        return pairs + sum(used[kind] for kind in one)

    objects = []
    for _ in range(count):
        chosen = min(left, key=often)
        left.remove(chosen)
        used.update([chosen[:2], chosen[1:], *chosen])
        objects.append(draw_object(*chosen, seed=int(rng.integers(2**31))))
    return tuple(objects)


def draw_object(primitive: str, texture: str, material: str, seed: int) -> Object:
    """Return an object of this kind, its sizes, phases and colour drawn from `seed`.

    Args:
        primitive: name of the shape.
        texture: name of the texture.
        material: name of the material.
        seed: of sizes, phases and colour.
    """
    rng = np.random.default_rng([seed, 11])
    made_of = MATERIALS[material]
    kind = TEXTURE_KINDS[texture]
    pitch = float(rng.uniform(*kind.pitch))
    if primitive in ("letters", "cone", "ring"):  # small contacts: finer textures
        pitch = kind.pitch[0] + 0.4 * (pitch - kind.pitch[0])
    # The depth follows from the slope, so that a gel can follow a fine texture too.
    steepness = float(rng.uniform(*_STEEPNESS))
    depth = min(max(steepness * pitch / max(kind.slope, 1.0), _DEPTHS[0]), _DEPTHS[1])
    if primitive == "letters":  # the stroke must stand out
        depth = min(depth, 0.18)
    letter = sorted(STROKES)[int(rng.integers(len(STROKES)))]
    grain_scale = float(rng.uniform(0.85, 1.2))
    shape = Shape(
        primitive,
        texture,
        size=round(float(rng.uniform(*PRIMITIVE_KINDS[primitive].size)), 3),
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
    noun = PRIMITIVE_KINDS[primitive].noun + (f" {letter}" if primitive == "letters" else "")
    red, green, blue = (round(float(c), 4) for c in colour)
    return Object(f"{kind.adjective} {material} {noun}", shape, made_of, (red, green, blue), seed)


def hold_out(
    objects: Sequence[Object], fraction: float, seed: int
) -> tuple[tuple[Object, ...], tuple[Object, ...]]:
    """Split objects into (training, held out) that share no (primitive, texture) pair.

    Both keep their order. At least `fraction` is held out. Training objects keep every primitive
    and texture, so that a held-out pair is new only as a pair. Raises UserError otherwise.
    """
    if not 0 < fraction < 1:
        raise UserError(
            f"the fraction of objects held out must lie between 0 and 1, not {fraction}"
        )
    pairs = sorted({o.kind for o in objects})
    sizes = Counter(o.kind for o in objects)
    primitives = Counter(p for p, _ in pairs)
    textures = Counter(t for _, t in pairs)
    test_pairs: set[Pair] = set()
    test_objects = 0
    for i in np.random.default_rng([seed, 12]).permutation(len(pairs)):
        if test_objects >= fraction * len(objects):
            break
        primitive, texture = pairs[i]
        if primitives[primitive] > 1 and textures[texture] > 1:
            test_pairs.add(pairs[i])
            primitives[primitive] -= 1
            textures[texture] -= 1
            test_objects += sizes[pairs[i]]
    if test_objects < fraction * len(objects):
        raise UserError(
            f"of {len(objects)} objects only {test_objects} can be held out without losing a "
            f"primitive or a texture; ask for less than {fraction:g} of them or draw more objects"
        )
    training = tuple(o for o in objects if o.kind not in test_pairs)
    return training, tuple(o for o in objects if o.kind in test_pairs)


def hardness_of(thing: Object) -> str:
    """Return "soft", "firm" or "hard"."""
    modulus = thing.material.modulus
    if modulus < SOFT:
        return "soft"
    if modulus < HARD:
        return "firm"
    return "hard"


def roughness_of(thing: Object) -> str:
    """Return "smooth", "textured" or "rough", by the RMS slope of the texture."""
    shape = thing.shape
    slope = TEXTURE_KINDS[shape.texture].slope * shape.texture_depth / shape.texture_pitch
    if slope == 0:
        return "smooth"
    if slope < _ROUGH:
        return "textured"
    return "rough"


# Captions, in the style of AnyTouch's annotations (its appendix on GPT-4o). They never name the
# object, its material, its form or the touch, so they do not reveal those labels. Two hints remain:
# most words for warmth and grip belong to one material, and wide spacing is rare for cones, rings
# and letters, which have finer textures.
HARDNESS: dict[str, tuple[str, ...]] = {
    "soft": ("soft", "yielding", "pliable", "squishy", "springy", "very soft"),
    "firm": ("firm", "fairly firm", "moderately firm", "semi-rigid", "tough"),
    "hard": ("hard", "rigid", "solid", "unyielding", "inflexible", "very hard"),
}
ROUGHNESS: dict[str, tuple[str, ...]] = {
    "smooth": ("smooth", "even", "sleek", "plain", "very smooth"),
    "textured": (
        "lightly textured",
        "slightly rough",
        "moderately rough",
        "mildly uneven",
        "gently textured",
    ),
    "rough": ("rough", "coarse", "strongly textured", "bumpy", "very rough"),
}
# {s} is a word for the spacing.
PATTERN: dict[str, tuple[str, ...]] = {
    "smooth": (
        "no noticeable pattern",
        "a uniform, unbroken finish",
        "hardly any surface detail",
        "no bumps or grooves",
        "a consistent finish",
    ),
    "weave": (
        "a {s} woven pattern",
        "{s} interlaced strands",
        "a {s} basket-like pattern",
        "{s} criss-crossing fibres",
        "a {s} pattern of interlaced strands",
    ),
    "knit": (
        "{s} knitted loops",
        "a {s} pattern of V-shaped stitches",
        "{s} rows of stitches",
        "a {s} looped, chain-like pattern",
        "{s} interlocking loops",
    ),
    "ridges": (
        "{s} parallel ridges",
        "a {s} ribbed pattern",
        "{s} raised lines",
        "{s} parallel grooves",
        "a {s} series of ridges and grooves",
    ),
    "grid": (
        "a {s} raised grid",
        "a {s} waffle-like lattice",
        "{s} square cells between raised lines",
        "a {s} pattern of crossing ridges",
        "{s} crossing ribs",
    ),
    "dots": (
        "{s} raised dots",
        "{s} rounded bumps",
        "a {s} array of small bumps",
        "{s} dot-like bumps",
        "a {s} pattern of studs",
    ),
    "bark": (
        "{s} irregular furrows",
        "{s} winding cracks",
        "a {s} fissured, bark-like surface",
        "{s} uneven plates and creases",
        "a {s} pattern of irregular grooves",
    ),
    "sand": (
        "{s} sandpaper-like grains",
        "a {s} gritty texture",
        "{s} random bumps and pits",
        "a {s} grainy texture",
        "{s} irregular grains",
    ),
}
SPACING: dict[str, tuple[str, ...]] = {
    "fine": ("fine", "closely spaced", "tight", "dense", "small-scale"),
    "wide": ("broad", "widely spaced", "large-scale", "spread-out", "big"),
}
WIDE = 1.85  # mm; from this pitch on a pattern is called wide

FIRST = (
    "The surface feels {hard} and {rough}, with {pattern}.",
    "The surface is {rough} and {hard}, showing {pattern}.",
    "A {hard}, {rough} surface with {pattern}.",
    "A {rough} surface with {pattern}; it feels {hard}.",
    "It feels {hard} to the touch, with a {rough} finish and {pattern}.",
    "{Hard} and {rough}, with {pattern}.",
    "{Rough}, {hard}, {pattern}.",
    "The object has {pattern}, giving a {rough} feel, and its body is {hard}.",
    "One can feel {pattern} on a {hard}, {rough} surface.",
    "To the fingertips it is {rough}, with {pattern}, and {hard} underneath.",
)
SECOND = (
    "It is {feel}.",
    "The touch is {feel}.",
    "Overall it feels {feel}.",
    "The sensation is {feel}.",
    "The material seems {feel}.",
)


def caption(thing: Object, rng: np.random.Generator) -> str:
    """Return one or two sentences about the object's feel.

    `rng` draws the words. The facts stay the same.
    """
    shape = thing.shape

    def pick(options: tuple[str, ...]) -> str:
        return options[int(rng.integers(len(options)))]

    spacing = "wide" if shape.texture_pitch >= WIDE else "fine"
    words = {
        "hard": pick(HARDNESS[hardness_of(thing)]),
        "rough": pick(ROUGHNESS[roughness_of(thing)]),
        "pattern": pick(PATTERN[shape.texture]).format(s=pick(SPACING[spacing])),
        "feel": pick(thing.material.feel),
    }
    words |= {"Hard": words["hard"].capitalize(), "Rough": words["rough"].capitalize()}
    text = pick(FIRST).format(**words)
    if rng.random() < 0.75:
        text += " " + pick(SECOND).format(**words)
    # "an even", but "a uniform"
    return re.sub(r"\b([Aa]) (?=[aeiou](?!ni))", r"\1n ", text)
