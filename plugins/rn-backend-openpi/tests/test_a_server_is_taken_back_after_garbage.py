"""A server, or what stands before it, sends garbage for a while: whatever it was, the robot is
served again soon afterwards, by itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing, suppress
from typing import Any

import pytest
from middle_man import MiddleMan, Recording, Send, frame_of, message_of, plain_frame
from policy_servers import SEEN, RunningServer, robot_of

from rn_backend_openpi.messages import RESERVED
from rn_testing.waiting import wait_until
from roboneuron import NotReadyError, RoboNeuronError

pytestmark = pytest.mark.timeout(180)
BACK_S = 20.0
"""A connection in progress takes up to 3 s, its greeting and the pause 2 s each; the rest is for a
busy machine.
"""


def changed(frame: bytes, **own: Any) -> bytes:
    """The frame with other values at `RESERVED`."""
    message = message_of(frame)
    return frame_of({**message, RESERVED: {**message.get(RESERVED, {}), **own}})


def greeting(frame: bytes, **own: Any) -> list[bytes]:
    """A first message with other values; answers are swallowed, so that the robot connects anew."""
    is_first = "state" in message_of(frame).get(RESERVED, {})
    return [changed(frame, **own)] if is_first else []


GARBAGE: dict[str, Send] = {
    "text": lambda _, frame: [b"HTTP/1.1 400 Bad Request\r\n\r\n" * 5],
    "bytes": lambda _, frame: [bytes(byte ^ 0xFF for byte in frame)],
    "nothing": lambda _, frame: [],
    "half a header": lambda _, frame: [frame[:3]],
    "half a frame": lambda _, frame: [frame[:-3]],
    "a long message that does not come": lambda _, frame: [
        b"\x82\x7f" + (1 << 26).to_bytes(8, "big")
    ],
    "a size beyond the limits": lambda _, frame: [b"\x82\x7f" + (1 << 62).to_bytes(8, "big")],
    "another version": lambda _, frame: greeting(frame, protocol=77),
    "another number": lambda _, frame: [changed(frame, number=77)],
    "another time": lambda _, frame: [changed(frame, clock_ns=5)],
    "a frame twice": lambda _, frame: [frame, frame],
    "no message": lambda _, frame: [b"\x82\x04nope"],
    "deep lists": lambda _, frame: [b"\x82\x7e" + (60_000).to_bytes(2, "big") + b"\x91" * 60_000],
    "an empty message": lambda _, frame: [frame_of({})],
    "words": lambda _, frame: [b"\x81\x04nope"],
    "a failure without words": lambda _, frame: [
        changed(frame, state="failed", pid=1, error={"code": 3})
    ],
    "a model that loads": lambda _, frame: greeting(frame, state="loading", pid=1),
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
