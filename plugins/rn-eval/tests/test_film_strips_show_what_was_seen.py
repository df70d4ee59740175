from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image

from rn_eval.film import Film

COLOURS = {"red": (200, 30, 30), "green": (30, 160, 60), "blue": (30, 60, 200), "yellow": (230, 200, 40)}


def table(colour):
    """A smooth grey picture that a small cube stands in, as the simulated camera's pictures are."""
    rows = np.linspace(90, 230, 160)[:, None, None] + np.linspace(-20, 20, 160)[None, :, None]
    image = np.clip(rows * np.array([1.0, 0.95, 0.9]), 0, 255).astype(np.uint8)
    image[80:88, 100:108] = colour
    return image


@pytest.mark.parametrize("name", COLOURS)
def test_a_small_cube_keeps_its_colour(name):
    """Each colour in a strip whose other images have the other ones."""
    film = Film()
    for at_s, colour in enumerate([COLOURS[name], *COLOURS.values()]):
        film.add(float(at_s), "", table(colour))
    strip = np.asarray(Image.open(io.BytesIO(film.strip())).convert("RGB")).astype(int)
    assert np.abs(strip[84, 104] - np.array(COLOURS[name])).max() <= 16
