"""Exposure changes from image to image, and the fitted colours of dents do not."""

import numpy as np
from hidden_sensor import colours_of_dents
from press_videos import gel_frame

from anytouch_jax.sim.fitting.fit import fit_sensor

PLACES = range(-40, 41, 5)
# Grey levels by which images are lighter or darker, and the fraction of each colour in them.
# Most levels are small: many images far from the others would be taken for another unit.
LEVELS = np.array([12, -12, 6, -6, 5, -5, 4, -4, 3, -3, 2, -2, 1, -1, 0, 0, 0])
FRACTIONS = np.array([1.0, 1.0, -0.5])


def test_a_change_of_exposure_does_not_change_the_fitted_colours(tmp_path):
    images = [gel_frame("coloured", 0.9, "ball", place, seed) for seed, place in enumerate(PLACES)]
    change = LEVELS[:, None] * FRACTIONS
    gel = gel_frame("coloured", 0.0, "ball", 0, 99)
    found = []
    for name, levels in (("as_taken", 0 * change), ("exposed", change)):
        taken = []
        for image, level in zip(images, levels, strict=True):
            lighter = image + level[None, None]
            taken.append(np.clip(lighter, 0, 255).astype(np.uint8))
        fitted = fit_sensor(taken, "mine", 18.6, tmp_path / f"{name}.sensor", background=gel)
        found.append(colours_of_dents(fitted.colour.look, fitted.colour.halo))
        assert abs(fitted.numbers.noise - 1.2) < 0.06, "the noise that the images were made with"
    plain, exposed = found
    apart = np.linalg.norm(exposed - plain) / np.linalg.norm(plain)
    assert np.linalg.norm(plain) > 0.1 and apart < 0.02, apart
