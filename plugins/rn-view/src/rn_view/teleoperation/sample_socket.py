"""Websocket of a page that leads: its samples feed a teleoperator."""

from __future__ import annotations

import asyncio
import json
import logging
import math
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np
from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

from rn_standard.teleoperation.samples import LeadFeedback, LeadSample, Subscribe
from rn_view.teleoperation.stick_panel import RATE_HZ
from roboneuron import (
    ForeignDataError,
    InvalidInputError,
    NotReadyError,
    RoboNeuronError,
    foreign,
)

log = logging.getLogger(__name__)
Call = Callable[[str, dict[str, object]], "Future[str]"]
"""Calls a tool as the holder of the page; the future gives the error text, empty on success."""
Fetch = Callable[[str], "Future[Mapping[str, object]]"]
"""Calls a tool that only reads, without arguments; the future gives its result, empty on
failure.
"""
OFFSET_S = 60.0
"""Time for which a message counts for the offset between the clocks. Those of two computers drift
apart by up to about 100 ppm, 6 ms in this time.
"""
_ECHO_S = 0.04
_MOST_HZ = 6 * RATE_HZ
"""Maximum number of messages a second; a page of this package sends fewer."""
_MOST_CHARACTERS = 2000
_REFUSED, _FLOODED = 4401, 1008
"""Close codes of the websocket. Source of the second: RFC 6455, 7.4.1."""
_AGAIN = "Open the page and start to lead again."


class ClockOffset:
    """Offset from a page's clock to ours: that of the message with the least delay within
    `OFFSET_S`.

    An offset for ever makes samples seem old once the clocks have drifted apart. The window is much
    longer than a lead without samples, so that a page that becomes slow is not taken for drift.
    """

    def __init__(self) -> None:
        # arrival times and offsets; both increase, because a smaller offset replaces earlier ones
        self._least: deque[tuple[float, float]] = deque()

    def after(self, sent_s: float, now_s: float) -> float:
        """Offset after a message [s].

        Args:
            sent_s: time of sending on the page's clock; NaN changes nothing.
            now_s: monotonic time of its arrival.
        """
        offset_s = now_s - sent_s
        if math.isfinite(offset_s):
            while self._least and self._least[-1][1] >= offset_s:
                self._least.pop()
            self._least.append((now_s, offset_s))
        while self._least and self._least[0][0] < now_s - OFFSET_S:
            self._least.popleft()
        return self._least[0][1] if self._least else offset_s


class PageTeleoperator:
    """Newest sample of a page; implements `Teleoperator` and `ToldTeleoperator`."""

    def __init__(self) -> None:
        self._news = threading.Condition()
        self._sample: LeadSample | None = None
        self._error: RoboNeuronError | None = None
        self._offset = ClockOffset()
        self.on_news: Callable[[dict[str, object]], object] = lambda news: None

    def open(self, subscribe: Subscribe) -> None:
        """Discard old samples, and what is known of the page's clock. Raises NotReadyError if the
        page is not connected.
        """
        with self._news:
            if isinstance(self._error, NotReadyError):
                raise self._error
            self._sample = self._error = None
            self._offset = ClockOffset()

    def read(self, timeout_s: float) -> LeadSample | None:
        """See `Teleoperator`."""
        with self._news:
            self._news.wait_for(lambda: self._sample or self._error, timeout_s)
            if self._error is not None:
                raise self._error
            sample, self._sample = self._sample, None
            return sample

    def close(self) -> None:
        """See `Teleoperator`; the page stays connected."""

    def tell(self, feedback: LeadFeedback) -> None:
        """See `ToldTeleoperator`."""
        self.on_news({"echo": [feedback.number, feedback.who, feedback.limits, feedback.note]})

    def ended(self, reason: str) -> None:
        """See `ToldTeleoperator`."""
        self.on_news({"led": False, "text": reason})

    def connected(self) -> None:
        """Called when the page's websocket opens."""
        with self._news:
            self._error, self._offset = None, ClockOffset()

    def lost(self, why: str) -> None:
        """Called when the page has disconnected."""
        with self._news:
            self._error = NotReadyError(f"{why}; the arm rests.", hint=_AGAIN)
            self._news.notify_all()

    def put(self, told: dict[str, Any], now_s: float) -> None:
        """Handle a message of the page. An invalid one ends its lead.

        Args:
            told: the decoded JSON.
            now_s: monotonic time of its arrival.
        """
        with self._news:
            try:
                self._sample = self._sample_of(told, now_s)
            except ForeignDataError as error:
                self._refuse(error)
            self._news.notify_all()

    def refuse(self, error: ForeignDataError) -> None:
        """Handle a message that cannot be decoded, as an invalid sample."""
        with self._news:
            self._refuse(error)
            self._news.notify_all()

    def _refuse(self, error: ForeignDataError) -> None:
        text = f"The page has sent an invalid sample ({error})"
        self._error = InvalidInputError(f"{text}; the arm rests.", hint="Reload the page.")

    def _sample_of(self, told: dict[str, Any], now_s: float) -> LeadSample:
        """Convert a message, with its time on our monotonic clock."""
        sent_s = _number(foreign.field(told, "t"), "t")
        joint, grip = told.get("joint"), told.get("grip")
        velocities, twist = {}, None
        if joint is not None:
            name, speed = foreign.items(joint, "joint", least=2, most=2)
            velocities = {foreign.text(name, "joint"): _number(speed, "joint")}
        else:
            values = foreign.items(foreign.field(told, "twist"), "twist", least=6, most=6)
            twist = np.array([_number(value, "twist") for value in values])
        number = foreign.integer(foreign.field(told, "n"), "n")
        offset_s = self._offset.after(sent_s, now_s)
        return LeadSample(
            number=number,
            at_s=sent_s + offset_s,
            is_held=told.get("held") is True,
            twist=twist,
            frame="tool" if told.get("tool") is True else "base",
            velocities=velocities,
            gripper_open=None if grip is None else _number(grip, "grip"),
        )


class LeadSockets:
    """Websockets of the pages that may lead, by key; usable from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._sockets: dict[str, _LeadSocket] = {}

    def add(
        self,
        name: str,
        source: PageTeleoperator,
        call: Call,
        fetch: Fetch,
        fold: Callable[[bool], object],
    ) -> str:
        """Permit a page to lead; returns its key.

        Args:
            name: of its teleoperator.
            source: receives its samples.
            call: calls a tool for it.
            fetch: calls a tool that only reads for it.
            fold: folds the panels beside the scene, while a person leads.
        """
        key = secrets.token_urlsafe(24)
        with self._lock:
            self._sockets[key] = _LeadSocket(name, source, call, fetch, fold)
        return key

    def remove(self, key: str) -> None:
        """Remove a page that is closed or may no longer lead."""
        with self._lock:
            socket = self._sockets.pop(key, None)
        if socket is not None:
            socket.source.lost("The page was closed")

    async def serve(self, connection: ServerConnection) -> None:
        """Serve one websocket until it closes; runs on viser's event loop."""
        assert connection.request is not None
        key = parse_qs(urlsplit(connection.request.path).query).get("key", [""])[0]
        with self._lock:
            socket = self._sockets.get(key)
        if socket is None or socket.is_taken:
            await connection.close(_REFUSED, "This page may not lead the arm.")
            return
        await socket.serve(connection)


class _LeadSocket:
    """Websocket of one page that may lead."""

    def __init__(
        self,
        name: str,
        source: PageTeleoperator,
        call: Call,
        fetch: Fetch,
        fold: Callable[[bool], object],
    ) -> None:
        self.source = source
        self.is_taken = False
        self._name, self._call, self._fetch, self._fold = name, call, fetch, fold
        self._loop: asyncio.AbstractEventLoop | None = None
        self._out: asyncio.Queue[dict[str, object]] = asyncio.Queue()
        self._echo: dict[str, object] | None = None
        self._echo_due = 0.0

    async def serve(self, connection: ServerConnection) -> None:
        self.is_taken, self._loop = True, asyncio.get_running_loop()
        self._out = asyncio.Queue()
        self.source.on_news = self._from_thread
        self.source.connected()
        sending = asyncio.ensure_future(self._send(connection))
        try:
            await self._receive(connection)
        except ConnectionClosed:
            log.debug("The page %s has disconnected.", self._name)
        finally:
            self.source.lost("The page has disconnected")
            sending.cancel()
            self.is_taken = False

    async def _receive(self, connection: ServerConnection) -> None:
        second, count = 0, 0
        async for message in connection:
            now_s = time.monotonic()
            count = count + 1 if int(now_s) == second else 1
            second = int(now_s)
            if count > _MOST_HZ or len(message) > _MOST_CHARACTERS:
                self.source.lost("The page sends too many or too large messages")
                await connection.close(_FLOODED, "Too many messages.")
                return
            try:
                told = foreign.table(foreign.decode_json(message, "a message"), "a message", 16)
            except ForeignDataError as error:
                self.source.refuse(error)
                continue
            if "begin" in told:
                self._begin(told["begin"])
            elif "back" in told:
                self._ask("hand_back", {})
            elif "operate" in told:
                self._ask("take_over", {})
            elif "fold" in told:
                self._fold(told["fold"] is True)
            elif "recordings" in told:
                self._list()
            elif "label" in told:
                self._label(told["label"])
            else:
                self.source.put(told, now_s)

    def _begin(self, asked: object) -> None:
        arguments: dict[str, object] = {"source": self._name}
        if isinstance(asked, dict):
            arguments |= {key: asked[key] for key in ("mode", "scale") if key in asked}
        self._ask("lead_arm", arguments)

    def _list(self) -> None:
        """Send the list of recordings to the page."""

        def answered(future: Future[Mapping[str, object]]) -> None:
            found = {} if future.exception() else future.result()
            self._from_thread({"recordings": found.get("runs", [])})

        self._fetch("list_recordings").add_done_callback(answered)

    def _label(self, asked: object) -> None:
        """Store a person's label of a recording; the tool checks the arguments."""
        arguments = dict(asked) if isinstance(asked, dict) else {}

        def answered(future: Future[str]) -> None:
            failure = str(future.exception() or "") or future.result()
            self._from_thread({"labelled": arguments.get("run", ""), "text": failure})

        self._call("label_recording", arguments).add_done_callback(answered)

    def _ask(self, tool: str, arguments: dict[str, object]) -> None:
        def answered(future: Future[str]) -> None:
            failure = str(future.exception() or "") or future.result()
            if tool == "lead_arm":
                self._from_thread({"led": not failure, "text": failure})
            elif tool == "take_over" and not failure:
                self._from_thread({"operates": True})
            elif failure:
                self._from_thread({"led": False, "text": failure})

        self._call(tool, arguments).add_done_callback(answered)

    def _from_thread(self, news: dict[str, object]) -> None:
        loop = self._loop
        if loop is not None and not loop.is_closed():
            loop.call_soon_threadsafe(self._put, news)

    def _put(self, news: dict[str, object]) -> None:
        """Queue a message to the page. Of echoes within 40 ms only the newest is sent."""
        if "echo" not in news:
            self._out.put_nowait(news)
            return
        is_first, self._echo = self._echo is None, news
        if is_first:
            asyncio.get_running_loop().call_at(self._echo_due, self._flush)

    def _flush(self) -> None:
        news, self._echo = self._echo, None
        self._echo_due = asyncio.get_running_loop().time() + _ECHO_S
        if news is not None:
            self._out.put_nowait(news)

    async def _send(self, connection: ServerConnection) -> None:
        try:
            while True:
                await connection.send(json.dumps(await self._out.get()))
        except ConnectionClosed:
            log.debug("The page %s has disconnected while receiving.", self._name)


def _number(value: object, what: str) -> float:
    """Number from JSON; null is NaN, because JavaScript writes NaN as null."""
    return math.nan if value is None else foreign.number(value, what)
