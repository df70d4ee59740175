"""A film of the front camera: an animated GIF of all frames, and a strip of the most informative
ones.
"""

from __future__ import annotations

import io
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

from PIL import Image, ImageDraw

_STRIP_FRAMES = 6
_MARGIN_PX = 4
_CAPTION_PX = 18
_SCALE = 2
_SHORTEST_FRAME_MS = 40


@dataclass(kw_only=True, slots=True)
class DemoFilm:
    """Collects frames; nothing is written before `save`.

    Attributes:
        frames: (seconds since the film began, caption, image) in order of time.
    """

    frames: list[tuple[float, str, Image.Image]] = field(default_factory=list)

    def add(self, at_s: float, caption: str, encoded: bytes) -> None:
        """Add one encoded image (PNG or JPEG) taken `at_s` seconds after the beginning."""
        image = Image.open(io.BytesIO(encoded)).convert("RGB")
        self.frames.append((at_s, caption, image))

    def save(self, directory: Path) -> tuple[Path, Path]:
        """Write `film-strip.png` and `film.gif`; returns their paths. There must be at least one
        frame.
        """
        directory.mkdir(parents=True, exist_ok=True)
        strip, gif = directory / "film-strip.png", directory / "film.gif"
        sheet = self._strip()
        sheet.save(strip)
        # One palette for all frames, by coverage: per-frame palettes by frequency lose the small
        # coloured cubes.
        palette = sheet.quantize(256, method=Image.Quantize.MAXCOVERAGE)
        images = [
            image.resize((image.width * _SCALE, image.height * _SCALE)).quantize(
                palette=palette, dither=Image.Dither.NONE
            )
            for _, _, image in self.frames
        ]
        times = [at_s for at_s, _, _ in self.frames]
        gaps = [max(_SHORTEST_FRAME_MS, round(1000 * (b - a))) for a, b in pairwise(times)]
        images[0].save(
            gif,
            save_all=True,
            append_images=images[1:],
            duration=[*gaps, 1500],
            loop=0,
            optimize=True,
        )
        return strip, gif

    def _strip(self) -> Image.Image:
        count = min(_STRIP_FRAMES, len(self.frames))
        last = len(self.frames) - 1
        chosen = [self.frames[round(i * last / max(1, count - 1))] for i in range(count)]
        width, height = chosen[0][2].size
        sheet = Image.new(
            "RGB",
            (count * (width + _MARGIN_PX) + _MARGIN_PX, height + 2 * _MARGIN_PX + _CAPTION_PX),
            "white",
        )
        draw = ImageDraw.Draw(sheet)
        for index, (at_s, caption, image) in enumerate(chosen):
            x = _MARGIN_PX + index * (width + _MARGIN_PX)
            sheet.paste(image.resize((width, height)), (x, _MARGIN_PX))
            draw.text(
                (x + 2, height + _MARGIN_PX + 3),
                f"{at_s:4.1f} s  {caption}"[: width // 6],
                fill="black",
            )
        return sheet
