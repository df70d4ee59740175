"""A server, or what stands before it, sends garbage for a while: whatever it was, the robot is
served again soon afterwards, by itself.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from contextlib import closing, suppress
from typing import Any

import pytest
from middle_man import MiddleMan, Recording, Send, plain_frame
from policy_servers import SEEN, RunningServer, robot_of

from rn_backend_shared.frames import HEADER_BYTES, FrameKind, Header, encode, read_header
from rn_testing.waiting import wait_until
from roboneuron import NotReadyError, RoboNeuronError

pytestmark = pytest.mark.timeout(180)
BACK_S = 20.0
"""A connection in progress takes up to 3 s, its greeting and the pause 2 s each; the rest is for a
busy machine.
"""


def with_header(frame: bytes, **changes: Any) -> bytes:
    """The frame with another header, whose sizes need not fit."""
    return read_header(frame[:HEADER_BYTES])._replace(**changes).pack() + frame[HEADER_BYTES:]


def with_document(frame: bytes, document: dict[str, Any]) -> bytes:
    """The frame with another document."""
    header: Header = read_header(frame[:HEADER_BYTES])
    return b"".join(bytes(part) for part in encode(header, document))


GARBAGE: dict[str, Send] = {
    "text": lambda _, frame: [b"HTTP/1.1 400 Bad Request\r\n\r\n" * 5],
    "bytes": lambda _, frame: [bytes(byte ^ 0xFF for byte in frame)],
    "nothing": lambda _, frame: [],
    "half a header": lambda _, frame: [frame[:7]],
    "half a frame": lambda _, frame: [frame[:-3]],
    "a long body that does not come": lambda _, frame: [with_header(frame, array_bytes=1 << 26)],
    "sizes beyond the limits": lambda _, frame: [
        frame[: HEADER_BYTES - 8] + struct.pack("!II", 1 << 31, 1 << 31)
    ],
    "another version": lambda _, frame: [frame[:4] + b"\x7f" + frame[5:]],
    "another kind": lambda _, frame: [with_header(frame, kind=FrameKind.STATUS)],
    "another number": lambda _, frame: [with_header(frame, number=77)],
    "another time": lambda _, frame: [with_header(frame, clock_ns=5)],
    "a frame twice": lambda _, frame: [frame, frame],
    "no JSON": lambda _, frame: [
        with_header(frame[:HEADER_BYTES], document_bytes=4, array_bytes=0) + b"nope"
    ],
    "deep JSON": lambda _, frame: [
        with_header(frame[:HEADER_BYTES], document_bytes=60_000, array_bytes=0) + b"[" * 60_000
    ],
    "an empty document": lambda _, frame: [with_document(frame, {})],
    "a failure without words": lambda _, frame: [
        with_document(frame, {"state": "failed", "pid": 1, "error": {"code": 3}})
    ],
    "a model that loads": lambda _, frame: [with_document(frame, {"state": "loading", "pid": 1})],
}


@pytest.mark.exhaustive
@pytest.mark.parametrize("kind", GARBAGE)
def test_a_server_is_taken_back_after_garbage(plain: RunningServer, kind: str) -> None:
    failures: list[RoboNeuronError] = []

    def fails(_: Recording, frame: bytes) -> Sequence[bytes]:
        return GARBAGE[kind](_, frame)

    with closing(MiddleMan(plain.port, plain_frame)) as man:
        robot = robot_of(
            man.address, token_file=str(plain.folder / "token"), coding="raw", timeout_s=0.4
        )
        with closing(robot):
            robot.load()

            def answers() -> bool:
                try:
                    robot.predict(SEEN)
                except RoboNeuronError as error:
                    failures.append(error)
                    return False
                return True

            wait_until(answers, 30.0, "it is served")
            failures.clear()
            man.answer = fails
            # three deadlines without an answer replace the connection, whose greeting is garbage
            wait_until(lambda: not answers() and len(failures) >= 5, 30.0, "garbage is noticed")
            man.honest()
            wait_until(answers, BACK_S, "it is served again")
            with suppress(NotReadyError):  # of a busy machine
                robot.predict(SEEN)
