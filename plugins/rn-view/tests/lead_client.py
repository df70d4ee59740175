"""A page without a browser that leads an arm: its websocket, with a scripted person."""

from __future__ import annotations

import json
import re
import threading
import time
from html import unescape
from types import TracebackType
from typing import Any, Self

from page_client import PageClient
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Origin, Subprotocol

from rn_testing.waiting import wait_until
from rn_view.teleoperation.stick_panel import PROTOCOL, SOCKET_PATH

_PATIENCE_S = 60.0


class LeadPage:
    """An open page that may lead, once it has given its token if the view asks for one; fields are
    read from any thread.
    """

    def __init__(self, url: str, token: str = "") -> None:
        self.page = PageClient(url)
        if token:
            wait_until(lambda: "Token" in self.page.labels, _PATIENCE_S, poll_s=0.05)
            self.page.choose("Token", token)
            self.page.choose("Show the robot", True)
        self.is_led = False
        self.text = ""
        self.echoes: list[tuple[int, str, str, str, float]] = []
        """Number of the sample, who acts, limits, note, and the way there and back [s]."""
        self._sent: dict[int, float] = {}
        self._number = 0
        self._answers = 0
        wait_until(lambda: bool(self._keys()), _PATIENCE_S, poll_s=0.05)
        self.key = self._keys()[-1]
        self.socket = connect(
            f"{url.replace('http', 'ws', 1)}{SOCKET_PATH}?key={self.key}",
            origin=Origin(url),
            subprotocols=[Subprotocol(PROTOCOL)],
        )
        self._reading = threading.Thread(target=self._read, daemon=True)
        self._reading.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.socket.close()
        self.page.close()

    def ask(self, value: dict[str, Any], timeout_s: float = 20.0) -> str:
        """Send a request and wait for its answer: why it was refused, empty when it was not."""
        before = self._answers
        self.socket.send(json.dumps(value))
        wait_until(lambda: self._answers > before, timeout_s, poll_s=0.01)
        return self.text

    def lead(self, mode: str = "person", scale: float = 1.0, *, operate: bool = True) -> str:
        """Ask for the arm, after becoming operator unless `operate` is false."""
        if operate:
            self.ask({"operate": 1})
        return self.ask({"begin": {"mode": mode, "scale": scale}})

    def send(self, twist: list[float] | None, *, held: bool = True, **facts: Any) -> None:
        """Send one sample."""
        self._number += 1
        self._sent[self._number] = time.monotonic()
        told = {"n": self._number, "t": time.monotonic(), "held": held, "grip": None}
        self.socket.send(json.dumps({**told, "twist": twist or [0.0] * 6, **facts}))

    def push(self, twist: list[float], seconds: float, *, held: bool = True, **facts: Any) -> None:
        """Send samples at 50 Hz for a while."""
        end_s = due_s = time.monotonic()
        end_s += seconds
        while due_s < end_s:
            self.send(twist, held=held, **facts)
            due_s += 0.02
            time.sleep(max(0.0, due_s - time.monotonic()))

    def press(self) -> None:
        """Release the deadman switch for a moment, so that it can be pressed again."""
        self.push([0.0] * 6, 0.1, held=False)

    def _keys(self) -> list[str]:
        shown = "".join(str(props.get("content", "")) for _, props in self.page._snapshot())
        return [unescape(key) for key in re.findall(r'id="rn-lead-key" data-key="([^"]+)"', shown)]

    def _read(self) -> None:
        try:
            for message in self.socket:
                self._take(json.loads(message))
        except ConnectionClosed:
            pass

    def _take(self, told: dict[str, Any]) -> None:
        if "echo" in told:
            number, who, limits, note = told["echo"]
            delay_s = time.monotonic() - self._sent.get(number, float("nan"))
            self.echoes.append((number, who, limits, note, delay_s))
            return
        if "led" in told:
            self.is_led, self.text = told["led"], told["text"]
        self._answers += 1
