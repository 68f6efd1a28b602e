"""Videos of a gel that is pressed for a fraction of the time, in three looks: lit in colours,
darkening, and with dots.
"""

import numpy as np

SHAPE = 120, 160
LOOKS = "coloured", "darkening", "dotted"
SENSORS = {"coloured": "gelsight_mini", "darkening": "9dtact", "dotted": "gelsight"}


def gel_frame(
    look: str, depth: float, shape: str = "ball", shift: float = 0.0, seed: int = 0
) -> np.ndarray:
    """Return one frame u8 RGB (120, 160, 3) of a gel pressed by `depth` (0 to 1) at `shift` pixels
    from the middle.
    """
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float64)
    rng = np.random.default_rng(seed)
    dent = depth * _dent(shape, x - 80 - shift, y - 60)
    if look == "darkening":  # as of a 9DTact: pressed gel is darker
        image = 165 - ((x - 80) ** 2 + (y - 60) ** 2) / 560 - 34 * dent
        image = np.repeat(image[..., None], 3, 2)
    else:
        image = np.dstack(
            [90 + 30 * np.exp(-((x - 80) ** 2 + (y - 60) ** 2) / 3000), 100 + 0 * x, 80 + y / 6]
        )
        contrast = 280 if look == "dotted" else 180
        image[..., 0] += contrast * np.gradient(dent, axis=1)
        image[..., 2] += contrast * np.gradient(dent, axis=0)
    if look == "dotted":
        for row in range(10, SHAPE[0], 16):
            for column in range(10, SHAPE[1], 16):
                near = np.exp(-((row - 60) ** 2 + (column - 80 - shift) ** 2) / 40**2)
                middle = column + 5 * depth * near  # shear moves the dots
                part = np.s_[row - 3 : row + 4, max(int(middle) - 3, 0) : int(middle) + 5]
                image[part][(y[part] - row) ** 2 + (x[part] - middle) ** 2 < 2.5**2] = 20
    image *= 1 + 0.02 * np.sin(seed)  # exposure drifts
    return np.clip(image + rng.normal(0, 1.2, image.shape), 0, 255).astype(np.uint8)


def press_video(
    look: str, fraction: float, shape: str = "ball", frames: int = 40
) -> tuple[list[np.ndarray], np.ndarray]:
    """Return the frames of one video and whether each is pressed: free, a press that slides,
    free.
    """
    pressed = round(fraction * frames)
    first = (frames - pressed + 1) // 2
    contact = (np.arange(frames) >= first) & (np.arange(frames) < first + pressed)
    seed = LOOKS.index(look) * 1000 + round(fraction * 100)
    images = []
    for number in range(frames):
        place = (number - first + 0.5) / max(pressed, 1)
        depth = (0.6 + 0.4 * np.sin(np.pi * place)) * contact[number]
        images.append(
            gel_frame(look, depth, shape, 14 * (place - 0.5) * contact[number], seed + number)
        )
    return images, contact


def _dent(shape: str, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    if shape == "ball":
        return np.asarray(np.clip(1 - (x**2 + y**2) / 26**2, 0, 1))
    if shape == "bar":
        return np.asarray(np.exp(-((np.abs(y) / 9) ** 4) - (x / 45) ** 4))
    inside = (np.abs(x) < 55) & (np.abs(y) < 42)
    # pins
    return np.asarray(inside * np.exp(-((((x + 8) % 16) - 8) ** 2 + (((y + 7) % 14) - 7) ** 2) / 8))
