"""Film strips: some of the images that the policy received, side by side."""

from __future__ import annotations

import io

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

_MOST = 32
_SHOWN = 6
_HEIGHT_PX, _CAPTION_PX, _MARGIN_PX = 160, 18, 3
_FONT_PX, _GAP_PX = 12, 10
_COLOURS = 256
"""The palette must cover the colours that occur: if it were chosen by pixel counts, a small yellow
cube would become as grey as the table.
"""


class FilmStrip:
    """Keeps at most 32 evenly spaced images of an episode, by reference without copying."""

    def __init__(self) -> None:
        self._frames: list[tuple[float, str, NDArray[np.uint8]]] = []
        self._stride, self._count = 1, 0

    def add(self, at_s: float, caption: str, image: NDArray[np.uint8]) -> None:
        """Offer an image, uint8 (H, W, 3), taken at simulated time `at_s`."""
        if self._count % self._stride == 0:
            self._frames.append((at_s, caption, image))
        self._count += 1
        if len(self._frames) > _MOST:
            self._frames = self._frames[::2]
            self._stride *= 2

    def strip(self, last: tuple[float, str, NDArray[np.uint8]] | None = None) -> bytes:
        """PNG of six images, including the first and the last; b"" without images."""
        frames = [*self._frames, *([last] if last else [])]
        if not frames:
            return b""
        count = min(_SHOWN, len(frames))
        chosen = [frames[round(i * (len(frames) - 1) / max(1, count - 1))] for i in range(count)]
        images = [Image.fromarray(image) for _, _, image in chosen]
        images = [
            i.resize((max(1, round(i.width * _HEIGHT_PX / i.height)), _HEIGHT_PX)) for i in images
        ]
        width = sum(i.width + _MARGIN_PX for i in images) - _MARGIN_PX
        sheet = Image.new("RGB", (width, _HEIGHT_PX + _CAPTION_PX), "white")
        draw, x = ImageDraw.Draw(sheet), 0
        font = ImageFont.load_default(_FONT_PX)
        for (at_s, caption, _), image in zip(chosen, images, strict=True):
            sheet.paste(image, (x, 0))
            time = f"{at_s:.1f} s"
            draw.text((x + 2, _HEIGHT_PX + 2), time, fill="black", font=font)
            at = 2 + draw.textlength(time, font) + _GAP_PX
            if at + draw.textlength(caption, font) <= image.width:
                draw.text((x + at, _HEIGHT_PX + 2), caption, fill="black", font=font)
            x += image.width + _MARGIN_PX
        buffer = io.BytesIO()
        sheet.quantize(_COLOURS, Image.Quantize.MAXCOVERAGE).save(buffer, "PNG", optimize=True)
        return buffer.getvalue()
