"""How much an interface takes in and gives out."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True, slots=True)
class InputLimits:
    """What one value from an agent may hold; more is refused before anything is built.

    Attributes:
        text_bytes: longest string, UTF-8 bytes.
        items: list elements in the whole value.
        binary_bytes: longest base64 text after decoding.
    """

    text_bytes: int = 262_144
    items: int = 262_144
    binary_bytes: int = 16_777_216


@dataclass(frozen=True, kw_only=True, slots=True)
class DecodeLimits:
    """How much of a message an agent gets to see; None stands for no bound.

    Attributes:
        items: longest array that is given whole; longer ones become a summary.
        first: how many elements a summary starts with.
        text: longest string that is given whole, in characters.
        values: elements of all arrays together; when they are used up, the rest is summarised
            without elements.
        names: give the name of a constant instead of its number.
        image_side_px: images are scaled down to this longest side.
    """

    items: int | None = 64
    first: int = 8
    text: int | None = 2000
    values: int | None = 2000
    names: bool = True
    image_side_px: int = 640


LOSSLESS = DecodeLimits(items=None, text=None, values=None, names=False)
"""Everything, so that encoding the result gives an equal message; long byte arrays come as base64.
"""
