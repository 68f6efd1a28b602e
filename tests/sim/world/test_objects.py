import dataclasses
from collections import Counter, defaultdict

import numpy as np
import pytest

from anytouch_jax.sim.world import objects
from anytouch_jax.sim.world.objects import (
    MATERIALS,
    catalogue,
    draw_object,
    hardness_of,
    hold_out,
    roughness_of,
)
from anytouch_jax.sim.world.shapes import PRIMITIVES, TEXTURES, Shape, height, relief

THINGS = catalogue(0)


@pytest.mark.parametrize("seed", range(2))
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
    textures = defaultdict(set)
    materials = defaultdict(set)
    for thing in THINGS:
        assert thing.shape.texture in thing.material.textures
        textures[thing.material.name].add(thing.shape.texture)
        materials[thing.shape.texture].add(thing.material.name)
    assert min(map(len, textures.values())) >= 3 and min(map(len, materials.values())) >= 4


@pytest.mark.parametrize("texture", TEXTURES)
def test_the_slopes_are_those_of_the_height_maps(texture):
    axis = np.arange(300) * 0.04
    result = []
    for seed in range(3):
        z = height(Shape("flat", texture, 1e3, 1.0, 1.0, seed=seed), *np.meshgrid(axis, axis))
        result.append(np.sqrt(np.mean(np.square(np.gradient(z, 0.04)).sum(0))))
    assert np.mean(result) == pytest.approx(objects.TEXTURE_KINDS[texture].slope, rel=0.06)


def test_no_two_objects_feel_alike():
    """The closest two of 64 differ by 20 micrometres RMS where either is touched, however they are
    turned.
    """
    maps = []
    for thing in THINGS:
        z = relief(thing.shape, 48, 0.2)
        if thing.shape.primitive in (
            "edge",
            "corner",
        ):  # over the plate, as their rims alone are alike
            x, y = np.meshgrid(np.arange(48) * 0.2 - 10, np.arange(48) * 0.2 - 10)
            z = height(thing.shape, x, y)
        maps.append(np.maximum(z, -1.2))
    flat = np.stack([np.stack([np.rot90(z, k).ravel() for k in range(4)]) for z in maps])
    for i, one in enumerate(flat):
        for two in flat[:i]:
            touched = (one[:1] > -1) | (two > -1)
            error = np.sum((two - one[:1]) ** 2, axis=-1, where=touched) / touched.sum(-1)
            assert np.sqrt(error).min() > 0.02


def test_labels_have_three_classes_each_and_follow_the_object():
    hardness = Counter(map(hardness_of, THINGS))
    roughness = Counter(map(roughness_of, THINGS))
    assert set(hardness) == {"soft", "firm", "hard"} and min(hardness.values()) >= 8
    assert set(roughness) == {"smooth", "textured", "rough"} and min(roughness.values()) >= 6
    for thing in THINGS:
        assert (roughness_of(thing) == "smooth") == (thing.shape.texture == "smooth")
    thing = draw_object("sphere", "ridges", "foam", 1)
    deep, shallow = (
        dataclasses.replace(thing, shape=dataclasses.replace(thing.shape, texture_depth=d))
        for d in (0.5, 0.05)
    )
    assert (roughness_of(deep), roughness_of(shallow), hardness_of(deep)) == (
        "rough",
        "textured",
        "soft",
    )


@pytest.mark.parametrize("fraction", [0.05, 0.2, 0.35])
@pytest.mark.parametrize("seed", range(2))
def test_whole_pairs_are_held_out(fraction, seed):
    received, unseen = hold_out(THINGS, fraction, seed)
    assert sorted((*received, *unseen), key=THINGS.index) == list(THINGS)
    assert list(received) == sorted(received, key=THINGS.index) and list(unseen) == sorted(
        unseen, key=THINGS.index
    )
    assert not {t.kind for t in received} & {t.kind for t in unseen}
    assert {t.shape.primitive for t in received} == set(PRIMITIVES) and {
        t.shape.texture for t in received
    } == set(TEXTURES)
    largest = max(Counter(t.kind for t in THINGS).values())
    assert fraction * 64 <= len(unseen) < fraction * 64 + largest
    assert hold_out(THINGS, fraction, seed) == (received, unseen)
