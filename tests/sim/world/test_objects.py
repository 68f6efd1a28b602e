import dataclasses
import math
from collections import Counter, defaultdict

import numpy as np
import pytest

from anytouch_jax.errors import UserError
from anytouch_jax.sim.world import objects
from anytouch_jax.sim.world.objects import (
    HARD,
    MATERIALS,
    SOFT,
    catalogue,
    combinations,
    draw_object,
    hardness_class,
    hardness_of,
    hold_out,
    roughness_of,
)
from anytouch_jax.sim.world.shapes import PRIMITIVES, Shape, height, relief
from anytouch_jax.sim.world.textures import GRAINS, TEXTURES

THINGS = catalogue(0)


def test_sixty_four_objects_that_have_names():
    assert len(THINGS) == 64
    assert len({thing.name for thing in THINGS}) == 64
    for thing in THINGS:
        adjective, material, *noun = thing.name.split()
        assert adjective == objects.TEXTURE_KINDS[thing.shape.texture].adjective and material == thing.material.name
        assert noun[0] == objects.PRIMITIVE_KINDS[thing.shape.primitive].noun
        assert noun[1:] == ([thing.shape.letter] if thing.shape.primitive == "letters" else [])


def test_the_seed_makes_the_catalogue_and_a_longer_one_begins_like_a_shorter():
    assert catalogue(0) == THINGS
    assert catalogue(0, 20) == THINGS[:20]
    assert catalogue(1) != THINGS
    whole = catalogue(2, len(combinations()))
    assert len({(t.kind, t.material.name) for t in whole}) == len(whole) > 300


@pytest.mark.parametrize("seed", range(4))
def test_all_kinds_occur_about_as_often(seed):
    things = catalogue(seed)
    for of, names in (
        (lambda t: t.shape.primitive, PRIMITIVES),
        (lambda t: t.shape.texture, TEXTURES),
        (lambda t: t.material.name, MATERIALS),
    ):
        counts = Counter(map(of, things))
        assert set(counts) == set(names) and max(counts.values()) <= 2 * min(counts.values())
    assert len({t.kind for t in things}) >= 50


def test_a_texture_does_not_give_the_material_away():
    textures, materials = defaultdict(set), defaultdict(set)
    for thing in THINGS:
        assert thing.shape.texture in thing.material.textures
        textures[thing.material.name].add(thing.shape.texture)
        materials[thing.shape.texture].add(thing.material.name)
    assert min(map(len, textures.values())) >= 3 and min(map(len, materials.values())) >= 4


@pytest.mark.parametrize("texture", TEXTURES)
def test_every_texture_is_made_of_soft_firm_and_hard_things(texture):
    made = {hardness_class(m.modulus) for m in MATERIALS.values() if texture in m.textures}
    assert len(made) >= 2 and "hard" in made


def test_sizes_suit_a_gel():
    for thing in catalogue(7, 128):
        shape = thing.shape
        low, high = objects.PRIMITIVE_KINDS[shape.primitive].size
        assert low <= shape.size <= high
        assert 0.8 <= shape.texture_pitch <= 3.0
        assert 0.1 <= shape.texture_depth <= 0.5 or shape.texture == "smooth"
        if shape.texture != "smooth":
            slope = objects.TEXTURE_KINDS[shape.texture].slope * shape.texture_depth / shape.texture_pitch
            assert slope <= 0.51 and (slope >= 0.14 or shape.primitive == "letters" or shape.texture_depth == 0.5)
        assert all(0 < c < 1 for c in thing.colour)


@pytest.mark.parametrize("texture", TEXTURES)
def test_the_slopes_are_those_of_the_height_maps(texture):
    axis = np.arange(300) * 0.04
    result = []
    for seed in range(3):
        z = height(Shape("flat", texture, 1e3, 1.0, 1.0, seed=seed), *np.meshgrid(axis, axis))
        result.append(np.sqrt(np.mean(np.square(np.gradient(z, 0.04)).sum(0))))
    assert np.mean(result) == pytest.approx(objects.TEXTURE_KINDS[texture].slope, rel=0.06)


def test_no_two_objects_feel_alike():
    """The closest two of 64 differ by 20 micrometres RMS where either is touched, however they are turned."""
    maps = []
    for thing in THINGS:
        z = relief(thing.shape, 48, 0.2)
        if thing.shape.primitive in ("edge", "corner"):  # over the plate, as their rims alone are alike
            x, y = np.meshgrid(np.arange(48) * 0.2 - 10, np.arange(48) * 0.2 - 10)
            z = height(thing.shape, x, y)
        maps.append(np.maximum(z, -1.2))
    flat = np.stack([np.stack([np.rot90(z, k).ravel() for k in range(4)]) for z in maps])
    for i, one in enumerate(flat):
        for two in flat[:i]:
            touched = (one[:1] > -1) | (two > -1)
            error = np.sum((two - one[:1]) ** 2, axis=-1, where=touched) / touched.sum(-1)
            assert np.sqrt(error).min() > 0.02


def test_materials_are_plausible():
    assert len(MATERIALS) >= 10
    for m in MATERIALS.values():
        assert 10 < m.modulus < 1e9 and 0.1 < m.friction < 1.5 and 0 <= m.gloss <= 1
        assert m.grain in GRAINS and set(m.textures) <= set(TEXTURES) and m.feel
    order = ["foam", "silicone", "rubber", "leather", "plastic", "glass", "steel"]
    moduli = [MATERIALS[name].modulus for name in order]
    assert moduli == sorted(moduli)
    assert hardness_class(SOFT) == "firm" and hardness_class(HARD) == "hard" and hardness_class(SOFT - 1) == "soft"


def test_labels_have_three_classes_each_and_follow_the_object():
    hardness, roughness = Counter(map(hardness_of, THINGS)), Counter(map(roughness_of, THINGS))
    assert set(hardness) == {"soft", "firm", "hard"} and min(hardness.values()) >= 8
    assert set(roughness) == {"smooth", "textured", "rough"} and min(roughness.values()) >= 6
    for thing in THINGS:
        assert (roughness_of(thing) == "smooth") == (thing.shape.texture == "smooth")
    thing = draw_object("sphere", "ridges", "foam", 1)
    deep, shallow = (
        dataclasses.replace(thing, shape=dataclasses.replace(thing.shape, texture_depth=d)) for d in (0.5, 0.05)
    )
    assert (roughness_of(deep), roughness_of(shallow), hardness_of(deep)) == ("rough", "textured", "soft")


@pytest.mark.parametrize("share", [0.05, 0.2, 0.35])
@pytest.mark.parametrize("seed", range(5))
def test_whole_pairs_are_held_out(share, seed):
    received, unseen = hold_out(THINGS, share, seed)
    assert sorted((*received, *unseen), key=THINGS.index) == list(THINGS)
    assert list(received) == sorted(received, key=THINGS.index) and list(unseen) == sorted(unseen, key=THINGS.index)
    assert not {t.kind for t in received} & {t.kind for t in unseen}
    assert {t.shape.primitive for t in received} == set(PRIMITIVES) and {t.shape.texture for t in received} == set(
        TEXTURES
    )
    largest = max(Counter(t.kind for t in THINGS).values())
    assert share * 64 <= len(unseen) < share * 64 + largest
    assert hold_out(THINGS, share, seed) == (received, unseen)


def test_other_seeds_hold_out_others():
    assert len({hold_out(THINGS, 0.2, seed)[1] for seed in range(6)}) == 6


def test_what_cannot_be_held_out_is_reported():
    for share in (0.0, 1.0, -0.1, math.nan):
        with pytest.raises(UserError, match="between 0 and 1"):
            hold_out(THINGS, share, 0)
    with pytest.raises(UserError, match="only 0 can be held out"):
        hold_out(THINGS[:1], 0.5, 0)
    with pytest.raises(UserError, match="draw more objects"):
        hold_out(THINGS, 0.95, 0)
    with pytest.raises(UserError, match="only 0"):
        hold_out([draw_object("cone", "sand", "cork", s) for s in range(3)], 0.5, 0)


def test_impossible_requests_are_named():
    for count in (0, -3, len(combinations()) + 1):
        with pytest.raises(UserError, match=f"not {count}"):
            catalogue(0, count)
    for bad in (("cube", "sand", "cork"), ("cone", "velvet", "cork"), ("cone", "sand", "butter")):
        with pytest.raises(UserError, match="there is no"):
            draw_object(*bad, seed=0)
