"""Captions of simulated objects, in the style of AnyTouch's annotations (its appendix on GPT-4o).

They describe hardness, roughness, texture, warmth and grip. They never name the object, its material, its form or the
touch (force, motion, direction), so they do not reveal those labels. Two hints remain. Most words for warmth and grip
belong to one material. Cones, rings and letters have finer textures, so wide spacing is rare for them.
"""

from __future__ import annotations

import re

import numpy as np

from anytouch_jax.sim.world.objects import Object, hardness_of, roughness_of

HARDNESS: dict[str, tuple[str, ...]] = {
    "soft": ("soft", "yielding", "pliable", "squishy", "springy", "very soft"),
    "firm": ("firm", "fairly firm", "moderately firm", "semi-rigid", "tough"),
    "hard": ("hard", "rigid", "solid", "unyielding", "inflexible", "very hard"),
}
ROUGHNESS: dict[str, tuple[str, ...]] = {
    "smooth": ("smooth", "even", "sleek", "plain", "very smooth"),
    "textured": ("lightly textured", "slightly rough", "moderately rough", "mildly uneven", "gently textured"),
    "rough": ("rough", "coarse", "strongly textured", "bumpy", "very rough"),
}
# {s} is a word for the spacing.
PATTERN: dict[str, tuple[str, ...]] = {
    "smooth": ("no noticeable pattern", "a uniform, unbroken finish", "hardly any surface detail",
               "no bumps or grooves", "a consistent finish"),
    "weave": ("a {s} woven pattern", "{s} interlaced strands", "a {s} basket-like pattern", "{s} criss-crossing fibres",
              "a {s} pattern of interlaced strands"),
    "knit": ("{s} knitted loops", "a {s} pattern of V-shaped stitches", "{s} rows of stitches",
             "a {s} looped, chain-like pattern", "{s} interlocking loops"),
    "ridges": ("{s} parallel ridges", "a {s} ribbed pattern", "{s} raised lines", "{s} parallel grooves",
               "a {s} series of ridges and grooves"),
    "grid": ("a {s} raised grid", "a {s} waffle-like lattice", "{s} square cells between raised lines",
             "a {s} pattern of crossing ridges", "{s} crossing ribs"),
    "dots": ("{s} raised dots", "{s} rounded bumps", "a {s} array of small bumps", "{s} dot-like bumps",
             "a {s} pattern of studs"),
    "bark": ("{s} irregular furrows", "{s} winding cracks", "a {s} fissured, bark-like surface",
             "{s} uneven plates and creases", "a {s} pattern of irregular grooves"),
    "sand": ("{s} sandpaper-like grains", "a {s} gritty texture", "{s} random bumps and pits", "a {s} grainy texture",
             "{s} irregular grains"),
}  # fmt: skip
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
    """Return one or two sentences about the object's feel. `rng` draws the words. The facts stay the same."""
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
    return re.sub(r"\b([Aa]) (?=[aeiou](?!ni))", r"\1n ", text)  # "an even", but "a uniform"
