from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image

from rn_eval.film import FilmStrip

COLOURS = {
    "red": (200, 30, 30),
    "green": (30, 160, 60),
    "blue": (30, 60, 200),
    "yellow": (230, 200, 40),
}


def table(colour):
    """A smooth grey image with a small cube, like the simulated camera's images."""
    rows = np.linspace(90, 230, 160)[:, None, None] + np.linspace(-20, 20, 160)[None, :, None]
    image = np.clip(rows * np.array([1.0, 0.95, 0.9]), 0, 255).astype(np.uint8)
    image[80:88, 100:108] = colour
    return image


@pytest.mark.parametrize("name", COLOURS)
def test_a_small_cube_keeps_its_colour(name):
    """Each colour, in a strip whose other images have the other colours."""
    film = FilmStrip()
    for at_s, colour in enumerate([COLOURS[name], *COLOURS.values()]):
        film.add(float(at_s), "", table(colour))
    strip = np.asarray(Image.open(io.BytesIO(film.strip())).convert("RGB")).astype(int)
    assert np.abs(strip[84, 104] - np.array(COLOURS[name])).max() <= 16


@pytest.mark.parametrize("width", [160, 224])
def test_time_and_caption_stand_apart(width):
    """Adjacent texts would read "30.0send" in the font of the strip."""
    film = FilmStrip()
    film.add(0.0, "", np.full((160, width, 3), 128, np.uint8))
    sheet = np.asarray(
        Image.open(io.BytesIO(film.strip((30.0, "end", film._frames[0][2])))).convert("L")
    )
    inked = np.flatnonzero((sheet[160:, width + 3 :] < 128).any(axis=0))
    assert len(inked) > 20
    assert np.diff(inked).max() >= 8


def test_a_caption_without_room_is_left_out():
    film = FilmStrip()
    film.add(0.0, "predicted-state", np.full((160, 60, 3), 128, np.uint8))
    sheet = np.asarray(Image.open(io.BytesIO(film.strip())).convert("L"))
    inked = np.flatnonzero((sheet[160:] < 128).any(axis=0))
    assert inked.max() < 40
