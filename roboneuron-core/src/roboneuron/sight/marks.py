"""Numbers drawn at objects, and objects found by number, name or place."""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from roboneuron import foreign
from roboneuron.contract import Frame
from roboneuron.contract.locator import LocatedObject
from roboneuron.errors import InvalidInputError
from roboneuron.server.tool import Picture
from roboneuron.sight.cell_view import CellView
from roboneuron.sight.sightlines import HandSight, is_seen_well

__all__ = ["marked"]
"""Names that other distributions may use."""

MOST_PX = 640
"""Greatest width of a picture for an agent."""
_RING_PX, _FONT_PX, _QUALITY = 6, 14, 88
Pixel = tuple[int, int]
"""Column and row."""
Box = tuple[int, int, int, int]
"""Left, top, right and bottom [px]."""
_MOST_WORD = 40


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class CellLook:
    """One look at the cell.

    Attributes:
        view: the pictures.
        objects: what the locator found; the mark of an object is its index plus one.
        failure: why the locator found nothing; empty if it worked.
        hidden: those of `objects` that are hidden or seen badly now, as they were last seen well.
        held: the object in each hand, by the arm; one that is not seen there is no mark.
        hands: where each hand is, and whether it holds something, by the arm.
    """

    view: CellView
    objects: tuple[LocatedObject, ...]
    failure: str = ""
    hidden: frozenset[LocatedObject] = frozenset()
    held: Mapping[str, LocatedObject] = field(default_factory=dict)
    hands: Mapping[str, HandSight] = field(default_factory=dict)

    def is_certain(self, one: LocatedObject) -> bool:
        """True if this look tells well where one of its objects is."""
        return one not in self.hidden and is_seen_well(one)


def name_of(one: LocatedObject) -> str:
    """What an object is called, such as "red cube": words of a locator, made printable."""
    return foreign.printable(f"{one.colour} {one.label}".strip(), _MOST_WORD)


def told_name(one: LocatedObject) -> str:
    """The name in quotation marks, for sentences: words of others never read as our own."""
    return foreign.quoted(name_of(one), _MOST_WORD)


def seen_names(objects: Sequence[LocatedObject]) -> str:
    """The objects with their marks, for messages."""
    told = ", ".join(f"{number} {told_name(one)}" for number, one in enumerate(objects, 1))
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
        hint=f"Seen: {seen_names(objects)}. Name one, or give its mark. What an arm hides is seen "
        "again from another posture.",
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
    """The picture of a frame as agents see it: at most `MOST_PX` wide; a small one is enlarged, so
    that its labels can be read.
    """
    from PIL import Image as Pillow  # heavy

    height, width = frame.image.shape[:2]
    factor = 1 / scale_of(frame)
    if factor == 1.0:
        return frame.image
    size = (round(width * factor), max(1, round(height * factor)))
    return np.asarray(Pillow.fromarray(frame.image).resize(size, Pillow.Resampling.BILINEAR))


def scale_of(frame: Frame) -> float:
    """Pixels of the frame for one of the picture `shown`."""
    width: int = frame.image.shape[1]
    return 0.5 if 2 * width <= MOST_PX else max(1.0, width / MOST_PX)


def pixels_of(look: CellLook) -> dict[str, dict[int, Pixel]]:
    """Where each mark is, in each picture `shown` of a camera that saw its object, by camera."""
    found: dict[str, dict[int, Pixel]] = {}
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


def look_pictures(
    look: CellLook, *, caption: str = "", cameras: Iterable[str] = ()
) -> list[Picture]:
    """A picture of each camera with the mark and the name of each object that it saw.

    Args:
        look: the look.
        caption: is written beside the camera's name.
        cameras: only of these, in their order; of all if empty.
    """
    pixels, frames = pixels_of(look), {frame.camera: frame for frame in look.view.frames}
    found = []
    for camera in cameras or frames:
        if camera in frames:
            labels = {place: _label(look, mark) for mark, place in pixels.get(camera, {}).items()}
            told = f"{foreign.printable(camera, _MOST_WORD)} {caption}".strip()
            found.append(marked(frames[camera], labels, told))
    return found


def _label(look: CellLook, mark: int) -> str:
    one = look.objects[mark - 1]
    return f"{mark} {name_of(one)}{' (as last seen)' if one in look.hidden else ''}"


def marked(frame: Frame, labels: Mapping[Pixel, str], caption: str) -> Picture:
    """JPEG file of a picture with a ring and a label at places in pixels, and a caption."""
    from PIL import Image as Pillow  # heavy
    from PIL import ImageDraw, ImageFont

    picture = Pillow.fromarray(shown(frame))
    draw = ImageDraw.Draw(picture)
    font = ImageFont.load_default(size=_FONT_PX)
    texts = [caption, *labels.values()]
    widths = [round(draw.textlength(text, font=font)) + 7 for text in texts]
    for place in labels:
        draw.ellipse(_ring(place), outline=(0, 0, 0), width=3)
        draw.ellipse(_ring(place), outline=(255, 255, 255), width=1)
    for text, box in zip(texts, label_boxes(list(labels), widths, picture.size), strict=True):
        draw.rectangle(box, fill=(0, 0, 0))
        draw.text((box[0] + 3, box[1]), text, font=font, fill=(255, 255, 255))
    buffer = io.BytesIO()
    picture.save(buffer, "JPEG", quality=_QUALITY)
    return Picture(data=buffer.getvalue(), mime_type="image/jpeg")


def label_boxes(places: Sequence[Pixel], widths: Sequence[int], size: Pixel) -> list[Box]:
    """Where texts are written: the caption in the upper left corner, the others beside the rings of
    their places, where they cover nothing if there is room.

    Args:
        places: of the labels.
        widths: of the caption and of each label.
        size: of the picture.
    """
    height, beside = _FONT_PX + 4, _RING_PX + 2
    boxes = [_within((0, 0, widths[0], height), size)]
    taken = [*map(_ring, places), *boxes]
    for (column, row), width in zip(places, widths[1:], strict=True):
        above, below = row - height - beside, row + beside
        rows = (row - height // 2, above, below, above - height, below + height)
        columns = (column + beside, column - beside - width, column - width // 2)
        corners = [(x, y) for y in rows for x in columns if (x, y) != (columns[2], rows[0])]
        choices = [_within((x, y, x + width, y + height), size) for x, y in corners]
        box = next((choice for choice in choices if not _meets(choice, taken)), choices[0])
        boxes.append(box)
        taken.append(box)
    return boxes


def _ring(place: Pixel) -> Box:
    column, row = place
    return (column - _RING_PX, row - _RING_PX, column + _RING_PX, row + _RING_PX)


def _within(box: Box, size: Pixel) -> Box:
    """A box moved into a picture of that size."""
    x = min(max(box[0], 0), max(0, size[0] - (box[2] - box[0])))
    y = min(max(box[1], 0), max(0, size[1] - (box[3] - box[1])))
    return (x, y, x + box[2] - box[0], y + box[3] - box[1])


def _meets(box: Box, others: Iterable[Box]) -> bool:
    return any(
        box[0] < other[2] and other[0] < box[2] and box[1] < other[3] and other[1] < box[3]
        for other in others
    )
