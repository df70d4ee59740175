"""Numbers drawn at objects, and objects found by number, name or place."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rn_standard.sight.cell_view import CellView
from rn_standard.sight.locator import LocatedObject
from roboneuron import Frame, InvalidInputError, Picture, foreign

MOST_PX = 640
"""Greatest width of a picture for an agent."""
_RING_PX, _QUALITY = 7, 88
_MOST_WORD = 40


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class CellLook:
    """One look at the cell.

    Attributes:
        view: the pictures.
        objects: what the locator found; the mark of an object is its index plus one.
        failure: why the locator found nothing; empty if it worked.
    """

    view: CellView
    objects: tuple[LocatedObject, ...]
    failure: str = ""


def name_of(one: LocatedObject) -> str:
    """What an object is called, such as "red cube": words of a locator, made printable."""
    return foreign.printable(f"{one.colour} {one.label}".strip(), _MOST_WORD)


def seen_names(objects: Sequence[LocatedObject]) -> str:
    """The objects with their marks, for messages."""
    told = ", ".join(f"{number} {name_of(one)}" for number, one in enumerate(objects, 1))
    return told or "nothing"


def find_object(objects: Sequence[LocatedObject], wanted: str | int) -> LocatedObject:
    """The object of that mark, or the only one that has all words of a name.

    Raises:
        InvalidInputError: there is none, or several; with what is seen.
    """
    if isinstance(wanted, int):
        if not 1 <= wanted <= len(objects):
            raise InvalidInputError(
                f"There is no mark {wanted}.",
                hint=f"Marks: {seen_names(objects)}. They are those of your last look.",
                path="mark",
            )
        return objects[wanted - 1]
    words = set(wanted.casefold().split())
    fitting = [one for one in objects if words and words <= set(name_of(one).casefold().split())]
    if len(fitting) == 1:
        return fitting[0]
    told = f"{len(fitting)} objects are" if fitting else "No object is"
    raise InvalidInputError(
        f"{told} seen by the name {foreign.quoted(wanted, _MOST_WORD)}.",
        hint=f"Seen: {seen_names(objects)}. Name one, or give its mark.",
        path="object",
    )


def nearest_like(
    objects: Sequence[LocatedObject], one: LocatedObject, within_m: float
) -> LocatedObject | None:
    """The object of the same name that is nearest to where `one` was, at most `within_m` away."""
    same = [
        (float(np.linalg.norm(other.position_m - one.position_m)), number, other)
        for number, other in enumerate(objects)
        if name_of(other) == name_of(one)
    ]
    found = min(same, default=None)
    return found[2] if found is not None and found[0] <= within_m else None


def shown(frame: Frame) -> NDArray[np.uint8]:
    """The picture of a frame, at most `MOST_PX` wide."""
    from PIL import Image as Pillow  # heavy

    height, width = frame.image.shape[:2]
    if width <= MOST_PX:
        return frame.image
    size = (MOST_PX, max(1, round(height * MOST_PX / width)))
    return np.asarray(Pillow.fromarray(frame.image).resize(size, Pillow.Resampling.BILINEAR))


def scale_of(frame: Frame) -> float:
    """Pixels of the frame for one of the picture `shown`."""
    width: int = frame.image.shape[1]
    return max(1.0, width / MOST_PX)


def pixels_of(look: CellLook) -> dict[str, dict[int, tuple[int, int]]]:
    """Where each mark is, in each picture `shown` of a camera that saw its object, by camera."""
    found: dict[str, dict[int, tuple[int, int]]] = {}
    for image in look.view.images:
        name = image.frame.camera
        height, width = image.frame.image.shape[:2]
        for number, one in enumerate(look.objects, 1):
            column, row = image.view.project(one.position_m).tolist()
            inside = 0 <= column < width and 0 <= row < height  # false for NaN
            if inside and name in one.cameras:
                scale = scale_of(image.frame)
                place = (int(column / scale), int(row / scale))
                found.setdefault(name, {})[number] = place
    return found


def marked(frame: Frame, marks: Mapping[int, tuple[int, int]]) -> Picture:
    """JPEG file of a picture with numbers at places in pixels."""
    from PIL import Image as Pillow  # heavy
    from PIL import ImageDraw, ImageFont

    picture = Pillow.fromarray(shown(frame))
    draw = ImageDraw.Draw(picture)
    font = ImageFont.load_default(size=13)
    for number, (column, row) in marks.items():
        ring = [column - _RING_PX, row - _RING_PX, column + _RING_PX, row + _RING_PX]
        draw.ellipse(ring, outline=(0, 0, 0), width=3)
        draw.ellipse(ring, outline=(255, 255, 255), width=1)
        place = (column + _RING_PX + 1, row - _RING_PX - 4)
        draw.text(
            place,
            str(number),
            font=font,
            fill=(255, 255, 255),
            stroke_width=2,
            stroke_fill=(0, 0, 0),
        )
    buffer = io.BytesIO()
    picture.save(buffer, "JPEG", quality=_QUALITY)
    return Picture(data=buffer.getvalue(), mime_type="image/jpeg")
