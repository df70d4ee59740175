"""Camera pictures of one page over a websocket of its own. Each is encoded once for all pages."""

from __future__ import annotations

import asyncio
import contextlib
import io
import json
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

from roboneuron import CameraProfile


class PictureStream:
    """The newest picture of each camera. A page gets the next one of a camera only after it has
    drawn the one before, so that a slow page shows few pictures instead of old ones.

    The websocket first sends the list of cameras as JSON, then pictures: the camera's place in the
    list as one byte, then a JPEG. The page answers each with that place as text.
    """

    def __init__(self, cameras: Sequence[CameraProfile]) -> None:
        self._places = {camera.name: place for place, camera in enumerate(cameras)}
        self._hello = json.dumps(
            [
                {
                    "label": camera.name
                    if camera.name == camera.role
                    else f"{camera.name} ({camera.role})",
                    "width": camera.width,
                    "height": camera.height,
                }
                for camera in cameras
            ]
        )
        self._newest: dict[int, bytes] = {}
        self._sending: _Sending | None = None

    def put(self, camera: str, jpeg: bytes) -> None:
        """Send a picture; from any thread. It replaces an earlier one that was not sent yet."""
        place = self._places[camera]
        self._newest[place] = jpeg
        sending = self._sending
        if sending is not None:
            sending.put(place, jpeg)

    def close(self) -> None:
        """End the websocket, because the page was closed; from any thread."""
        sending = self._sending
        if sending is not None:
            sending.end()

    async def serve(self, connection: ServerConnection) -> None:
        """Serve one websocket until it closes; the newest one gets the pictures."""
        self._sending = sending = _Sending(dict(self._newest), set(self._places.values()))
        with contextlib.suppress(ConnectionClosed):
            await connection.send(self._hello)
            await sending.serve(connection)
        if self._sending is sending:
            self._sending = None


class _Sending:
    """One websocket: pictures to send, and the cameras whose last picture was drawn."""

    def __init__(self, waiting: dict[int, bytes], drawn: set[int]) -> None:
        self._waiting, self._drawn, self._places = waiting, drawn, frozenset(drawn)
        self._loop, self._news = asyncio.get_running_loop(), asyncio.Event()
        self._news.set()
        self._is_over = False

    def end(self) -> None:
        self._is_over = True
        self._wake()

    def put(self, place: int, jpeg: bytes) -> None:
        self._waiting[place] = jpeg
        self._wake()

    def _wake(self) -> None:
        with contextlib.suppress(RuntimeError):  # the server is closing
            self._loop.call_soon_threadsafe(self._news.set)

    async def serve(self, connection: ServerConnection) -> None:
        receiving = asyncio.ensure_future(self._receive(connection))
        try:
            while not (receiving.done() or self._is_over):
                await self._news.wait()
                self._news.clear()
                for place in sorted(self._drawn & self._waiting.keys()):
                    self._drawn.discard(place)
                    await connection.send(bytes([place]) + self._waiting.pop(place))
        finally:
            receiving.cancel()

    async def _receive(self, connection: ServerConnection) -> None:
        try:
            async for message in connection:
                self._drawn.update(place for place in self._places if message == str(place))
                self._news.set()
        finally:
            self._news.set()


def jpeg(pixels: NDArray[np.uint8], most_px: int, quality: int) -> bytes:
    """Encode RGB pixels (height, width, 3) as JPEG, at most `most_px` wide."""
    from PIL import Image  # heavy

    picture = Image.fromarray(np.ascontiguousarray(pixels))
    picture.thumbnail((most_px, most_px * 4))
    out = io.BytesIO()
    picture.save(out, "JPEG", quality=quality)
    return out.getvalue()
