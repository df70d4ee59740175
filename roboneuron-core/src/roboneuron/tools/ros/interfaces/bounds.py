"""Limits on the size of encoded and decoded values."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True, slots=True)
class InputLimits:
    """Limits of one value from an agent; a larger one is refused before anything is built.

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
    """Limits of a message as shown to an agent; None for no bound.

    Attributes:
        items: longest array that is given completely; longer ones become a summary.
        first: number of elements at the start of a summary.
        text: longest string that is given completely, in characters.
        values: elements of all arrays together; beyond them, arrays are summarised without
            elements.
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
"""No limits, so that encoding the result gives an equal message; long byte arrays are base64."""
