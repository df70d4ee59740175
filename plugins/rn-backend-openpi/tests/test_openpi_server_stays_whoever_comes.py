"""The server with clients that are slow, silent, numerous, or send arbitrary data: one connection
ends, the others are still answered.
"""

from __future__ import annotations

import re
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Any

import msgpack
import numpy as np
import pytest
from openpi_clients import (
    GREY,
    REQUEST,
    SLACK_S,
    STATE,
    ask,
    open_client,
    served,
)
from openpi_format import encode
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.frames import Frame, Opcode
from websockets.sync.client import ClientConnection, connect

from rn_backend_openpi.case import Reflex, serving
from rn_testing.waiting import is_closed
from roboneuron import ActionChunk

NAN = STATE.copy()
NAN[2] = np.nan
DEEP: Any = 1
for _ in range(40):
    DEEP = [DEEP]


@pytest.mark.parametrize(
    ("request_", "word"),
    [
        (b"", "ForeignDataError"),
        (b"\xc1", "not in openpi's format"),
        (b"\x00" * 1000, "ForeignDataError"),
        ("text", "this one is text"),
        (msgpack.packb([1]), "expected a map"),
        (msgpack.packb(np.zeros(3), default=encode), "is no table"),
        ({**REQUEST, "prompt": DEEP}, "nested more than"),
        ({**REQUEST, "x": list(range(5000))}, "exceeds"),
        ({**REQUEST, "prompt": "x" * 100_000}, "exceeds"),
        ({**REQUEST, "endpoint": "shell"}, "no endpoint 'shell'"),
        ({**REQUEST, "observation/state": NAN}, "UnsafeError"),
        ({**REQUEST, "observation/state": np.zeros(3)}, "expected \\(8,\\)"),
        ({**REQUEST, "observation/image": GREY[..., 0]}, "no uint8 array"),
        ({**REQUEST, "roboneuron": {"left_s": -1.0}}, "left_s is -1"),
        ({**REQUEST, "roboneuron": {"left_s": float("nan")}}, "not finite"),
        ({**REQUEST, "roboneuron": {"left_s": 0.0}}, "NotReadyError"),
        (
            {
                **REQUEST,
                "observation/image": {
                    b"__ndarray__": True,
                    b"data": b"",
                    b"dtype": "|u1",
                    b"shape": [2**40, 0],
                },
            },
            "ForeignDataError",
        ),
        (
            {
                **REQUEST,
                "x": {b"__ndarray__": True, b"data": b"1" * 8, b"dtype": "|O", b"shape": [1]},
            },
            "not a number type",
        ),
        ({"prompt": "go"}, "is missing"),
        ({1: 2}, "ForeignDataError"),
    ],
)
def test_garbage_ends_its_own_connection_and_no_other(request_: Any, word: str) -> None:
    with served() as url, open_client(url) as good:
        before = ask(good)["actions"]
        with open_client(url) as bad:
            told = ask(bad, request_)
            assert isinstance(told, str)
            assert re.search(word, told), told
            assert "Traceback" not in told
            assert "\n" not in told
            _is_over(bad, 1011)
        np.testing.assert_array_equal(ask(good)["actions"], before)


def _is_over(bad: ClientConnection, code: int) -> str:
    """The reason with which a server has closed a connection."""
    with pytest.raises(ConnectionClosed) as caught:
        bad.recv(timeout=SLACK_S)
    assert caught.value.rcvd is not None
    assert caught.value.rcvd.code == code
    return caught.value.rcvd.reason


def test_numbered_nonsense_ends_its_own_connection_and_numbers_are_drawn_for_each() -> None:
    numbers = set()
    with serving(Reflex()) as url, open_client(url) as good:
        for own, word in (
            ({"number": 0, "clock_ns": 0}, "was replayed"),
            ({"number": 2, "clock_ns": 0, "left_s": 5.0}, "was replayed"),
            ({"number": 1}, "'clock_ns' is missing"),
            ({"number": 1, "clock_ns": 0, "robot": 7}, "ForeignDataError"),
        ):
            with open_client(url) as bad:
                before = bad.metadata["roboneuron"]["number"]
                numbers.add(before)
                told = ask(bad, {"roboneuron": {**own, "number": before + own["number"]}})
                assert word in told
                assert "see the text" in _is_over(bad, 1011)
        with open_client(url) as bad:  # what it says of the observation, then a repetition
            first = {"number": bad.metadata["roboneuron"]["number"] + 1, "clock_ns": 0}
            request = {"roboneuron": {**first, "left_s": 5.0}}
            answer = ask(bad, request)["roboneuron"]
            assert (answer["number"], answer["error"]) == (first["number"], "invalid_input")
            assert "was replayed" in ask(bad, request)
        assert ask(good, PLAIN)["actions"].shape == (4, 7)
    assert len(numbers) == 4


@pytest.mark.parametrize(
    "frame",
    [
        Frame(Opcode.BINARY, b"\x91" * 100_000).serialize(mask=True),
        Frame(Opcode.BINARY, b"nope").serialize(mask=False),
        b"\x82\xff" + (1 << 40).to_bytes(8, "big") + bytes(4),
        b"\xff" * 64,
    ],
)
def test_a_frame_that_is_none_ends_its_own_connection_and_no_other(frame: bytes) -> None:
    with served() as url, open_client(url) as good:
        with open_client(url) as bad:
            bad.socket.sendall(frame)
            with suppress(ConnectionClosed):
                while True:
                    bad.recv(timeout=SLACK_S)
            assert bad.close_code is not None
        assert ask(good)["actions"].shape == (4, 7)


def test_a_frame_that_is_too_large_is_not_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rn_backend_openpi.listener.MOST_BYTES", 2**20)
    with served() as url, open_client(url) as good:
        with open_client(url) as bad:
            with suppress(ConnectionClosed):
                bad.send(b"x" * 2**21)
            _is_over(bad, 1009)
        assert ask(good)["actions"].shape == (4, 7)


def test_random_bytes_before_the_handshake_disturb_nobody() -> None:
    rng = np.random.default_rng(7)
    with served() as url, open_client(url) as good:
        address = ("127.0.0.1", int(url.rsplit(":", 1)[1]))
        for size in (1, 10, 1000, 100_000):
            with socket.create_connection(address, timeout=SLACK_S) as stranger, suppress(OSError):
                stranger.sendall(rng.bytes(size))
        assert ask(good)["actions"].shape == (4, 7)


@pytest.mark.exhaustive
def test_many_who_say_nothing_keep_nobody_out(monkeypatch: pytest.MonkeyPatch) -> None:
    # so that none of them times out before the others are answered
    monkeypatch.setattr("rn_backend_openpi.listener.HANDSHAKE_S", 120.0)
    with served(robots=4) as url, ExitStack() as opened:
        good = opened.enter_context(open_client(url))
        address = ("127.0.0.1", int(url.rsplit(":", 1)[1]))
        strangers = [
            opened.enter_context(socket.create_connection(address, timeout=SLACK_S))
            for _ in range(300)
        ]
        late = opened.enter_context(open_client(url))
        assert ask(late)["actions"].shape == (4, 7)
        assert ask(good)["actions"].shape == (4, 7)
        # only as many as the bound are kept, the newest ones
        assert [is_closed(stranger, 0.5) for stranger in strangers[:200]] == [True] * 200


class Wide(Reflex):
    """Answers with more numbers than a socket buffer holds."""

    chunk = ActionChunk(actions=np.full((80_000, 7), 0.5), step_s=0.1)

    def predict(self, observation: Any) -> Any:
        return self.chunk


PLAIN = msgpack.packb(
    {"observation/image": GREY, "prompt": "go", "observation/gripper_open": STATE[:1]},
    default=encode,
)


@contextmanager
def _reading_nothing(url: str) -> Iterator[None]:
    """A client that sends requests repeatedly and reads no answer."""
    with socket.socket() as plain:
        plain.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        plain.connect(("127.0.0.1", int(url.rsplit(":", 1)[1])))
        quiet = {"compression": None, "max_size": None, "proxy": None, "close_timeout": 0.1}
        slow = connect(url, sock=plain, max_queue=1, **quiet)
        slow.recv(timeout=SLACK_S)
        with suppress(ConnectionClosed, OSError):
            for _ in range(4):
                slow.send(PLAIN)
        yield
        plain.close()
        slow.close()


def test_a_client_that_does_not_read_holds_nobody_up(monkeypatch: pytest.MonkeyPatch) -> None:
    # waiting for it would take a minute, `ask` waits for a part of that
    monkeypatch.setattr("rn_backend_openpi.listener.SEND_S", 60.0)
    with (
        serving(Wide()) as url,
        _reading_nothing(url),
        open_client(url) as good,
    ):
        for _ in range(3):
            assert ask(good, PLAIN)["actions"].shape == (80_000, 7)


@pytest.mark.exhaustive
def test_a_client_that_does_not_read_is_dropped(caplog: pytest.LogCaptureFixture) -> None:
    with (
        serving(Wide(), robots=1) as url,
        _reading_nothing(url),
    ):
        deadline_s = time.monotonic() + 30.0
        while True:
            try:
                with open_client(url) as good:  # the only place is free again
                    assert ask(good, PLAIN)["actions"].shape == (80_000, 7)
                break
            except InvalidStatus:
                assert time.monotonic() < deadline_s
    assert "does not read; it is dropped" in caplog.text


def test_a_client_that_asks_nothing_for_long_is_let_go(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rn_backend_openpi.conversation.IDLE_S", 0.3)
    with served() as url, open_client(url) as idle:
        assert _is_over(idle, 1001) == "idle"
