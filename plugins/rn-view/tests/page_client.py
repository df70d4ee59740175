"""The page without a browser: what its program keeps of the elements, and the messages that it
sends.
"""

from __future__ import annotations

import json
import re
import threading
from html import unescape
from typing import Any
from urllib.parse import quote
from urllib.request import Request, urlopen

import msgspec
import viser
import zstandard
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin, Subprotocol

from rn_testing.waiting import wait_until
from rn_view.page.stop_bar import HEADER, HEADER_VALUE, STOP_PATH
from rn_view.teleoperation.stick_panel import PROTOCOL as LEAD_PROTOCOL
from rn_view.web.page_requests import PICTURES_PATH
from roboneuron.supervisor.health import EXPLANATIONS

PROTOCOL = f"viser-v{viser.__version__}"
CAMERA: dict[str, Any] = {
    "type": "ViewerCameraMessage",
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (1.0, 1.0, 1.0),
    "fov": 1.3,
    "near": 0.1,
    "far": 100.0,
    "image_height": 600,
    "image_width": 800,
    "look_at": (0.0, 0.0, 0.0),
    "up_direction": (0.0, 0.0, 1.0),
}
"""Where a browser says it looks from; before that viser shows it nothing."""
_HEAD_BYTES = 16
"""Of a message: its size and that of its compressed part, 8 bytes each. Source: viser 1.1,
`_message_producer`.
"""


def ask_stop(url: str, robot: str = "", **headers: str) -> str:
    """Send the request of the button above the page; needs no page. Raises HTTPError when it is
    refused.
    """
    path = f"{STOP_PATH}?robot={quote(robot)}" if robot else STOP_PATH
    request = Request(url + path, headers={HEADER: HEADER_VALUE, **headers})
    with urlopen(request, timeout=60) as answer:
        return str(json.load(answer)["text"])


def opened_pictures(page: PageClient) -> ClientConnection:
    """The websocket with the pictures of a page, after its list of cameras was read."""
    wait_until(lambda: bool(page.key), 60.0, poll_s=0.02)
    socket = connect_pictures(page.url, page.key)
    socket.recv(60.0)
    return socket


def connect_pictures(url: str, key: str) -> ClientConnection:
    """Open a websocket for pictures."""
    return connect(
        f"{url.replace('http', 'ws', 1)}{PICTURES_PATH}?key={key}",
        origin=Origin(url),
        subprotocols=[Subprotocol(LEAD_PROTOCOL)],
    )


def next_picture(socket: ClientConnection, timeout_s: float = 60.0) -> bytes:
    """Receive a JPEG of the first camera and ask for the next one."""
    message = socket.recv(timeout_s)
    assert isinstance(message, bytes)
    socket.send(str(message[0]))
    return message[1:]


class PageClient:
    """A page that is open from the beginning until `close`; fields are read from any thread."""

    def __init__(self, url: str, **headers: str) -> None:
        self.url = url
        self._elements: dict[str, dict[str, Any]] = {}
        self._socket = connect(
            url.replace("http", "ws", 1),
            origin=Origin(url),
            subprotocols=[Subprotocol(PROTOCOL)],
            additional_headers=headers,
            max_size=None,
        )
        self._socket.send(msgspec.msgpack.encode(CAMERA))
        self._reading = threading.Thread(target=self._read, daemon=True)
        self._reading.start()

    def close(self) -> None:
        """Close the page."""
        self._socket.close()
        self._reading.join(10.0)

    @property
    def is_closed(self) -> bool:
        """Whether the server has closed the connection."""
        return not self._reading.is_alive()

    @property
    def text(self) -> str:
        """Text of the HTML elements, one per line."""
        contents = [str(props.get("content", "")) for _, props in self._snapshot()]
        return "\n".join(unescape(re.sub(r"<[^>]*>", " ", content)) for content in contents)

    def health(self, kind: str) -> str:
        """Health of a module, as the colour's tooltip explains it; empty while the page does not
        show it.
        """
        shown = unescape("".join(str(props.get("content", "")) for _, props in self._snapshot()))
        found = re.search(rf'title="([^"]*)">[^<]*</span> <b>{kind}</b>', shown)
        return next(
            (word for word, text in EXPLANATIONS.items() if found and text == found.group(1)), ""
        )

    @property
    def key(self) -> str:
        """Key of the page for its requests; empty while it has none."""
        shown = "".join(str(props.get("content", "")) for _, props in self._snapshot())
        found = re.search(r'id="rn-page-key"[^>]* data-key="([^"]+)"', shown)
        return "" if found is None else unescape(found.group(1))

    def press_stop(self, robot: str = "") -> str:
        """Press the emergency stop above the page, of one robot or of all; returns the text shown
        then.
        """
        return ask_stop(self.url, robot)

    def choose(self, label: str, value: object) -> None:
        """Set the value of an element."""
        uuid = next(uuid for uuid, props in self._snapshot() if props.get("label") == label)
        message = {"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": value}}
        self._socket.send(msgspec.msgpack.encode(message))

    @property
    def labels(self) -> set[str]:
        """Labels of the elements on the page."""
        return {str(props.get("label")) for _, props in self._snapshot()}

    def _snapshot(self) -> list[tuple[str, dict[str, Any]]]:
        return list(self._elements.items())

    def _read(self) -> None:
        try:
            for data in self._socket:
                assert isinstance(data, bytes)
                size = int.from_bytes(data[8:_HEAD_BYTES], "little")
                packed = zstandard.ZstdDecompressor().decompress(
                    data[_HEAD_BYTES : _HEAD_BYTES + size]
                )
                for message in msgspec.msgpack.decode(packed)["messages"]:
                    self._keep(message)
        except ConnectionClosed:
            pass

    def _keep(self, message: dict[str, Any]) -> None:
        uuid = message.get("uuid")
        if uuid is None:
            return
        if "props" in message:
            self._elements[uuid] = {"type": message["type"], **message["props"]}
        elif message["type"] == "GuiRemoveMessage":
            self._elements.pop(uuid, None)
        elif message["type"] == "GuiUpdateMessage":
            props = self._elements.setdefault(uuid, {"type": ""})
            props.update(message["updates"])
