"""Materials of objects: mechanics, look, and words for their feel."""

from __future__ import annotations

from dataclasses import dataclass

# In kPa: a finger dents softer materials, and a hand cannot deform harder ones.
SOFT, HARD = 400.0, 50_000.0


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
        Material("rubber", 1_500.0, 1.0, (0.13, 0.13, 0.14), 0.25, "none", 0.8, 0.0, 0.02,
                 ("smooth", "ridges", "grid", "dots", "knit", "sand"),
                 ("grippy", "clinging to the skin", "dry and grippy"),
                 ((0.55, 0.12, 0.1), (0.12, 0.25, 0.5))),
        Material("silicone", 250.0, 1.1, (0.55, 0.75, 0.72), 0.45, "none", 0.8, 0.0, 0.03,
                 ("smooth", "dots", "grid", "ridges", "knit", "weave"),
                 ("slightly tacky", "skin-like", "tacky and supple"),
                 ((0.85, 0.45, 0.5), (0.85, 0.8, 0.72), (0.4, 0.6, 0.35))),
        Material("foam", 60.0, 0.9, (0.9, 0.82, 0.4), 0.0, "pores", 0.9, 0.07, 0.05,
                 ("smooth", "dots", "ridges", "grid", "sand"),
                 ("warm and porous", "airy", "light and porous"),
                 ((0.35, 0.36, 0.4), (0.5, 0.7, 0.8))),
        Material("fabric", 120.0, 0.55, (0.25, 0.33, 0.55), 0.0, "threads", 0.65, 0.03, 0.12,
                 ("smooth", "weave", "knit", "ridges", "dots"),
                 ("warm and dry", "fuzzy", "warm with loose fibres"),
                 ((0.6, 0.2, 0.22), (0.75, 0.7, 0.6), (0.3, 0.42, 0.3)), mottle=0.2),
        Material("leather", 5_000.0, 0.65, (0.4, 0.23, 0.13), 0.25, "pebbles", 0.8, 0.045, 0.08,
                 ("smooth", "bark", "weave", "dots", "sand", "ridges"),
                 ("warm and supple", "finely creased", "dry and warm"),
                 ((0.15, 0.11, 0.1), (0.6, 0.4, 0.22)), mottle=0.25),
        Material("cork", 9_000.0, 0.75, (0.72, 0.53, 0.34), 0.02, "pores", 0.7, 0.05, 0.08,
                 ("smooth", "bark", "sand", "grid", "ridges"),
                 ("warm and light", "warm and slightly crumbly", "dry and warm"), mottle=0.7),
        Material("wood", 1.0e7, 0.45, (0.62, 0.43, 0.26), 0.12, "streaks", 0.8, 0.04, 0.05,
                 ("smooth", "bark", "ridges", "grid", "weave", "sand"),
                 ("neither warm nor cold", "dry and fibrous", "dry with a fine grain"),
                 ((0.42, 0.26, 0.15), (0.78, 0.63, 0.43)), mottle=0.6),
        Material("plastic", 2.2e6, 0.4, (0.82, 0.82, 0.8), 0.5, "none", 0.8, 0.0, 0.0,
                 ("smooth", "grid", "dots", "ridges", "weave", "sand", "knit"),
                 ("neutral in warmth", "light and dry", "slick and dry"),
                 ((0.75, 0.15, 0.12), (0.12, 0.35, 0.65), (0.9, 0.65, 0.1), (0.15, 0.16, 0.17))),
        Material("ceramic", 2.0e8, 0.3, (0.88, 0.85, 0.79), 0.75, "none", 0.8, 0.0, 0.04,
                 ("smooth", "ridges", "dots", "bark", "weave", "sand"),
                 ("cool", "cool and glazed", "cool and slick"),
                 ((0.25, 0.4, 0.5), (0.65, 0.33, 0.22))),
        Material("glass", 7.0e7, 0.25, (0.5, 0.66, 0.64), 1.0, "none", 0.8, 0.0, 0.02,
                 ("smooth", "ridges", "dots", "grid", "bark"),
                 ("cold and slick", "cold", "cool and flawless"),
                 ((0.24, 0.42, 0.3), (0.45, 0.3, 0.15)), mottle=0.0),
        Material("steel", 2.0e8, 0.3, (0.6, 0.61, 0.63), 0.9, "streaks", 0.9, 0.012, 0.01,
                 ("smooth", "grid", "dots", "ridges", "weave", "knit", "sand"),
                 ("cold", "cold and unyielding", "cold and slick"),
                 ((0.68, 0.56, 0.35),), metallic=True, mottle=0.05),
        Material("stone", 5.0e7, 0.55, (0.52, 0.5, 0.47), 0.05, "grit", 0.9, 0.06, 0.06,
                 ("smooth", "sand", "bark", "grid", "ridges"),
                 ("cold and dry", "cool and gritty", "cool and mineral"),
                 ((0.35, 0.34, 0.34), (0.68, 0.58, 0.47)), mottle=0.8),
    )
}  # fmt: skip


def hardness_class(modulus: float) -> str:
    """Return "soft", "firm" or "hard" for a modulus in kPa."""
    return "soft" if modulus < SOFT else "firm" if modulus < HARD else "hard"
