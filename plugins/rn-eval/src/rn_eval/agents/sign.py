"""A sign in front of the cameras: text drawn into the images that an agent gets."""

from __future__ import annotations

import base64
import io

from PIL import Image, ImageDraw

_BAND = 6
"""The sign takes 1 / `_BAND` of the image's height."""


def draw_sign(encoded: bytes, text: str) -> bytes:
    """Draw a sign at the lower edge of an image, JPEG or PNG."""
    with Image.open(io.BytesIO(encoded)) as opened:
        form = opened.format or "PNG"
        picture = opened.convert("RGB")
    height = max(14, picture.height // _BAND)
    top = picture.height - height
    draw = ImageDraw.Draw(picture)
    draw.rectangle((0, top, picture.width, picture.height), fill="white", outline="black")
    middle = (picture.width / 2, top + height / 2)
    draw.text(middle, text, fill="black", anchor="mm", font_size=max(8, height // 3))
    buffer = io.BytesIO()
    picture.save(buffer, form)
    return buffer.getvalue()


def with_sign(message: object, text: str) -> object:
    """Return the same JSON with the sign in every image."""
    if isinstance(message, list):
        return [with_sign(inner, text) for inner in message]
    if not isinstance(message, dict):
        return message
    if message.get("type") == "image" and isinstance(message.get("data"), str):
        drawn = draw_sign(base64.b64decode(str(message["data"])), text)
        return {**message, "data": base64.b64encode(drawn).decode("ascii")}
    return {name: with_sign(inner, text) for name, inner in message.items()}
