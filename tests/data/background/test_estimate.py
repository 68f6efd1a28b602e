import numpy as np
import pytest
from press_videos import LOOKS, SENSORS, gel_frame, press_video

from anytouch_jax.data.background.contact import THRESHOLDS
from anytouch_jax.data.background.estimate import (
    UntouchedBackground,
    background_of_unit,
    estimate_background_image,
    scale_image,
    without_islands,
)

SHAPES = "ball", "bar", "pins"


def estimate(frames):
    return estimate_background_image([scale_image(frame) for frame in frames])


@pytest.mark.parametrize("fraction", [0.1, 0.95])
@pytest.mark.parametrize(("look", "shape"), list(zip(LOOKS, SHAPES, strict=True)))
def test_videos_that_are_pressed_for_any_fraction_of_the_time_are_decided_and_not_inverted(
    look, shape, fraction
):
    frames, contact = press_video(look, fraction, shape)
    gel, _ = estimate(frames)
    assert gel is not None and gel.has_dots == (look == "dotted")
    predicted = np.array([gel.score(frame) for frame in frames]) > THRESHOLDS[SENSORS[look]]
    assert (predicted == contact).mean() >= 0.95


@pytest.mark.parametrize("look", LOOKS)
@pytest.mark.parametrize("depth", [0.0, 1.0])
def test_a_video_that_is_always_free_or_always_pressed_is_undecided(look, depth):
    gel, reason = estimate([gel_frame(look, depth, seed=seed) for seed in range(12)])
    assert gel is None and "always" in reason


@pytest.mark.parametrize(("look", "shape"), list(zip(LOOKS, SHAPES, strict=True)))
def test_a_press_that_moves_and_gets_deeper_and_never_ends_is_undecided(look, shape):
    # its lightest frames look like the untouched gel of the others
    frames, _ = press_video(look, 1.0, shape, 20)
    assert estimate(frames)[0] is None


def test_too_few_frames_are_undecided():
    assert (
        estimate([])
        == estimate([gel_frame("coloured", 1)])
        == (None, "fewer than two frames can be read")
    )


@pytest.mark.parametrize("look", ["coloured", "darkening"])
def test_pins_are_contact_and_moved_dots_are_not(look):
    free = gel_frame(look, 0)
    pins = gel_frame(look, 1, "pins", seed=1)
    gel = UntouchedBackground(free)
    # dents look like dots
    assert UntouchedBackground(pins).has_dots and not gel.has_dots
    assert (
        gel.score(gel_frame(look, 0, seed=2)) < 2
        and gel.score(pins) > 2 * THRESHOLDS[SENSORS[look]]
    )
    dots = UntouchedBackground(gel_frame("dotted", 0))
    assert (
        dots.has_dots
        and dots.score(gel_frame("dotted", 1, "pins", seed=1)) > 2 * THRESHOLDS["gelsight"]
    )
    moved = np.roll(gel_frame("dotted", 0, seed=3), 2, axis=1)
    assert dots.score(moved) < THRESHOLDS["gelsight"] < UntouchedBackground(free).score(moved)


def test_a_deeper_press_scores_more_at_any_resolution_and_light():
    clean = gel_frame("coloured", 0)
    light = np.array([25, -15, 10])
    gel = UntouchedBackground(clean)
    lamp = np.linspace(30, -10, 160)[:, None] * np.array([1, 0.3, -0.5])
    scores = [gel.score(gel_frame("coloured", depth, seed=1)) for depth in (0, 0.1, 0.3, 1)]
    assert scores == sorted(scores) and scores[0] < 2 and gel.score(clean) == 0
    pressed = gel_frame("coloured", 1, seed=1)
    assert UntouchedBackground(pressed).score(clean) == pytest.approx(scores[-1], rel=0.1)
    assert gel.score(np.repeat(np.repeat(pressed, 2, 0), 2, 1)) == pytest.approx(
        scores[-1], rel=0.1
    )
    assert UntouchedBackground(np.rot90(clean)).score(np.rot90(pressed)) == pytest.approx(
        scores[-1], rel=0.1
    )
    for change in (light, lamp):
        free, other = (np.clip(one + change, 0, 255).astype(np.uint8) for one in (clean, pressed))
        assert np.abs(free.astype(int) - clean).mean() > 7 and gel.score(free) < 1.5
        assert gel.score(other) == pytest.approx(scores[-1], rel=0.1)


def test_estimates_of_one_unit_agree_or_do_not():
    free = [UntouchedBackground(gel_frame("coloured", 0, seed=seed)) for seed in range(3)]
    pressed = [
        UntouchedBackground(gel_frame("coloured", 1, "pins", seed=seed)) for seed in range(2)
    ]
    for backgrounds in (free, [*free, *pressed], [pressed[0], *free[:2]]):
        agreed = background_of_unit(backgrounds)
        assert agreed is not None and agreed.score(free[0].image) < 2
    for backgrounds in ([], free[:1], [free[0], pressed[0]], [*free[:2], *pressed]):
        assert background_of_unit(backgrounds) is None


def test_images_of_other_proportions_are_refused():
    gel = UntouchedBackground(gel_frame("coloured", 0))
    for frame in (np.zeros((160, 120, 3), np.uint8), np.zeros((4, 160, 3), np.uint8)):
        with pytest.raises(ValueError, match="proportions"):
            gel.score(frame)
    with pytest.raises(ValueError, match="thin"):
        UntouchedBackground(np.zeros((6, 160, 3), np.uint8)).score(np.zeros((6, 160, 3), np.uint8))


def test_islands_at_the_border_are_not_contact() -> None:
    """The largest part stays, small ones at the border and specks go, others stay."""
    mask = np.zeros((100, 120), np.uint8)
    mask[30:60, 30:70] = 1  # contact, 1200 pixels
    mask[0:5, 0:8] = 1  # an island in a corner
    mask[80, 60] = 1  # a speck
    kept = mask.copy()
    kept[0:5, 0:8] = 0
    kept[80, 60] = 0
    mask[80:88, 20:28] = kept[80:88, 20:28] = 1  # a second contact, away from the border
    mask[40:60, 112:120] = kept[40:60, 112:120] = 1  # a larger one that the border cuts
    np.testing.assert_array_equal(without_islands(mask), kept)
    assert without_islands(mask > 0).dtype == bool
    # one part alone is contact wherever it lies
    alone = np.zeros_like(mask)
    alone[:4, :4] = 1
    np.testing.assert_array_equal(without_islands(alone), alone)
    assert not without_islands(np.zeros_like(mask)).any()
