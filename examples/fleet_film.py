"""Film of several robots: their images side by side, as an animated GIF and as a sheet of six
frames.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

from rn_simulation.planar_motion import PlanarPose

PANEL_PX, THUMB_PX = 320, 192
MARGIN_PX, CAPTION_PX = 6, 22
STRIP_COLUMNS = 6
SHORTEST_FRAME_MS = 40
FLOOR, GRID, PLAN, TRACK = (238, 240, 243), (218, 222, 228), (150, 158, 170), (226, 96, 32)
BODY, NOSE = (52, 73, 94), (241, 196, 15)
SMOOTHING = 2


@dataclass(kw_only=True)
class FleetFilm:
    """Collects frames; writes nothing before `save`.

    Attributes:
        frames: (time since the start [s], image by robot, caption by robot) in order of time.
    """

    frames: list[tuple[float, dict[str, Image.Image], dict[str, str]]] = field(default_factory=list)

    def add(
        self, at_s: float, images: Mapping[str, Image.Image | None], captions: Mapping[str, str]
    ) -> None:
        """Add a frame; a robot without an image keeps its previous one, or a grey one."""
        before = self.frames[-1][1] if self.frames else {}
        shown = {
            name: (
                image or before.get(name) or Image.new("RGB", (PANEL_PX, PANEL_PX), FLOOR)
            ).resize((PANEL_PX, PANEL_PX), Image.Resampling.LANCZOS)
            for name, image in images.items()
        }
        self.frames.append((at_s, shown, dict(captions)))

    def save(self, directory: Path) -> tuple[Path, Path]:
        """Write `film-strip.png` and `film.gif`; return their paths. At least one frame is
        required.
        """
        strip, gif = directory / "film-strip.png", directory / "film.gif"
        sheet = self._strip()
        sheet.save(strip)
        # One palette for all frames, by octree: by frequency the small coloured cubes get lost, by
        # coverage the shades.
        palette = sheet.quantize(256, method=Image.Quantize.FASTOCTREE)
        sheets = [self._side_by_side(*frame) for frame in self.frames]
        images = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in sheets]
        times = [at_s for at_s, _, _ in self.frames]
        gaps = [max(SHORTEST_FRAME_MS, round(1000 * (b - a))) for a, b in pairwise(times)]
        images[0].save(
            gif,
            save_all=True,
            append_images=images[1:],
            duration=[*gaps, 1500],
            loop=0,
            optimize=True,
        )
        return strip, gif

    def _side_by_side(
        self, at_s: float, images: Mapping[str, Image.Image], captions: Mapping[str, str]
    ) -> Image.Image:
        width = len(images) * (PANEL_PX + MARGIN_PX) + MARGIN_PX
        sheet = Image.new("RGB", (width, PANEL_PX + 2 * MARGIN_PX + CAPTION_PX), "white")
        draw = ImageDraw.Draw(sheet)
        for index, (name, image) in enumerate(images.items()):
            x = MARGIN_PX + index * (PANEL_PX + MARGIN_PX)
            sheet.paste(image, (x, MARGIN_PX))
            draw.text(
                (x + 2, PANEL_PX + MARGIN_PX + 3),
                captions.get(name, name),
                fill="black",
                font=_font(14),
            )
        clock, font = f"{at_s:.1f} s", _font(14)
        left = width - MARGIN_PX - draw.textlength(clock, font=font)
        draw.text((left, PANEL_PX + MARGIN_PX + 3), clock, fill="black", font=font)
        return sheet

    def _strip(self) -> Image.Image:
        """One row per robot, one column per frame."""
        count = min(STRIP_COLUMNS, len(self.frames))
        last = len(self.frames) - 1
        # The arms do most of their work in the first half, so more frames are taken there.
        chosen = [self.frames[round(last * (i / max(1, count - 1)) ** 1.5)] for i in range(count)]
        names = list(chosen[0][1])
        step = THUMB_PX + MARGIN_PX
        size = (count * step + MARGIN_PX, len(names) * (step + CAPTION_PX) + MARGIN_PX)
        sheet = Image.new("RGB", size, "white")
        draw = ImageDraw.Draw(sheet)
        for column, (at_s, images, captions) in enumerate(chosen):
            for row, name in enumerate(names):
                x, y = MARGIN_PX + column * step, MARGIN_PX + row * (step + CAPTION_PX)
                sheet.paste(
                    images[name].resize((THUMB_PX, THUMB_PX), Image.Resampling.LANCZOS), (x, y)
                )
                said = captions.get(name, name) if column == 0 else _end_of(captions, name)
                draw.text(
                    (x + 2, y + THUMB_PX + 3), f"{at_s:.1f} s  {said}", fill="black", font=_font(12)
                )
        return sheet


def draw_from_above(
    planned: Sequence[PlanarPose], track: Sequence[PlanarPose], size_px: int = PANEL_PX
) -> Image.Image:
    """The floor from above with a grid of 0.5 m: the planned path, the driven one, and the base at
    its end.
    """
    size = size_px * SMOOTHING
    xs, ys = [pose.x_m for pose in planned], [pose.y_m for pose in planned]
    middle = ((min(xs) + max(xs)) / 2, (min(ys) + max(ys)) / 2)
    span_m = max(max(xs) - min(xs), max(ys) - min(ys)) + 0.9
    scale = size / span_m

    def at(x_m: float, y_m: float) -> tuple[float, float]:
        return size / 2 + (x_m - middle[0]) * scale, size / 2 - (y_m - middle[1]) * scale

    image = Image.new("RGB", (size, size), FLOOR)
    draw = ImageDraw.Draw(image)
    for index in range(-20, 21):
        line_m = index * 0.5
        draw.line([at(line_m, -10), at(line_m, 10)], fill=GRID, width=SMOOTHING)
        draw.line([at(-10, line_m), at(10, line_m)], fill=GRID, width=SMOOTHING)
    draw.line([at(p.x_m, p.y_m) for p in planned], fill=PLAN, width=SMOOTHING)
    if len(track) > 1:
        draw.line([at(p.x_m, p.y_m) for p in track], fill=TRACK, width=3 * SMOOTHING, joint="curve")
    pose = track[-1] if track else planned[0]
    x, y = at(pose.x_m, pose.y_m)
    radius = 0.13 * scale
    draw.ellipse([x - radius, y - radius, x + radius, y + radius], fill=BODY)
    nose = [_turned(pose, 0.12, 0.0), _turned(pose, -0.02, 0.07), _turned(pose, -0.02, -0.07)]
    draw.polygon([at(*point) for point in nose], fill=NOSE)
    return image.resize((size_px, size_px), Image.Resampling.LANCZOS)


def _turned(pose: PlanarPose, forwards_m: float, left_m: float) -> tuple[float, float]:
    cos, sin = math.cos(pose.yaw_rad), math.sin(pose.yaw_rad)
    return pose.x_m + forwards_m * cos - left_m * sin, pose.y_m + forwards_m * sin + left_m * cos


def _end_of(captions: Mapping[str, str], name: str) -> str:
    """The variable part of a caption, after the comma."""
    return captions.get(name, "").partition(", ")[2]


def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)
