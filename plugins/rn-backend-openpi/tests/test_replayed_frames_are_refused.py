"""A man in the middle records the messages of a robot and a policy server, and replays them: the
arm executes none of them, the model computes none again, and the connection ends with an error that
says so.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from middle_man import (
    Cut,
    MiddleMan,
    Recording,
    Send,
    frame_of,
    message_of,
    plain_frame,
    tls_record,
)
from policy_servers import Robot, RunningServer, Serve, answers, robot_of, seen

from rn_backend_openpi.backend import PolicyBackend
from rn_backend_openpi.messages import RESERVED
from rn_testing.waiting import wait_until
from roboneuron import NotReadyError, RoboNeuronError

pytestmark = pytest.mark.timeout(200)
BACK_S = 20.0
"""A connection in progress takes up to 3 s, its greeting and the pause 2 s each; the rest is for a
busy machine.
"""


@pytest.fixture
def in_the_middle() -> Iterator[Callable[[int, Cut], MiddleMan]]:
    """Return a function that puts a man in the middle before a port."""
    men: list[MiddleMan] = []

    def stand(port: int, cut: Cut) -> MiddleMan:
        men.append(MiddleMan(port, cut))
        return men[-1]

    yield stand
    for man in men:
        man.close()


Stand = Callable[[int, Cut], MiddleMan]
RAW = {"coding": "raw", "timeout_s": 3.0}


@pytest.fixture(scope="module")
def expected(plain: RunningServer) -> list[Any]:
    """The rows for each observation, requested without a man in the middle."""
    with closing(robot_of(plain.address, **shown(plain))) as robot:
        robot.load()
        return [robot.predict(seen(number)).actions for number in range(5)]


def shown(server: RunningServer) -> dict[str, Any]:
    """Options of a robot that sends the server's token."""
    return {**RAW, "token_file": str(server.folder / "token")}


def logged(server: RunningServer) -> str:
    """The log of the model's process."""
    return Path(server.status()["models"]["only"]["log"]).read_text()


def kind_of(frame: bytes) -> str:
    """`request`, `answer`, `welcome`, or nothing for other frames."""
    found = message_of(frame)
    if "prompt" in found:
        return "request"
    if "actions" in found:
        return "answer"
    return "welcome" if "state" in found.get(RESERVED, {}) else ""


def of_kind(frames: Sequence[bytes], kind: str) -> list[bytes]:
    return [frame for frame in frames if kind_of(frame) == kind]


def computed(server: RunningServer) -> int:
    """Number of observations computed by the model."""
    return int(server.status()["models"]["only"]["observations"])


def ask(robot: PolicyBackend, number: int) -> Any:
    """The rows for an observation; None if there is no answer but an error with a reason."""
    try:
        return robot.predict(seen(number)).actions
    except NotReadyError as error:
        return str(error)


def twice(recording: Recording, frame: bytes) -> Sequence[bytes]:
    return (frame, frame)


def the_one_before(frames: Sequence[bytes], frame: bytes, kind: str) -> Sequence[bytes]:
    """Replace this frame by the previous one."""
    if kind_of(frame) != kind or not of_kind(frames, kind):
        return (frame,)
    return (of_kind(frames, kind)[-1],)


ANSWERS: dict[str, Send] = {
    "twice": twice,
    "old-in-its-place": lambda recording, frame: the_one_before(
        recording.answered, frame, "answer"
    ),
    "old-before-it": lambda recording, frame: (
        *the_one_before(recording.answered, frame, "answer"),
        frame,
    ),
    "question-sent-back": lambda recording, frame: (recording.asked[-1],),
}
REQUESTS: dict[str, Send] = {
    "twice": twice,
    "old-in-its-place": lambda recording, frame: the_one_before(recording.asked, frame, "request"),
    "old-before-it": lambda recording, frame: (
        *the_one_before(recording.asked, frame, "request"),
        frame,
    ),
    # a new connection has no request yet
    "introduced-again": lambda recording, frame: (*list(recording.asked)[:1], frame),
}


def judge(robot: PolicyBackend, man: MiddleMan, expected: Sequence[Any]) -> list[str]:
    """Send some requests during the replay; each answer must be the right one or an error, and the
    robot must continue afterwards. Returns the errors.
    """
    said = []
    for number in (2, 3, 4):
        found = ask(robot, number)
        if isinstance(found, str):
            said.append(found)
        else:
            np.testing.assert_array_equal(found, expected[number])
    man.honest()
    wait_until(lambda: answers(robot), 20.0, "it is answered again")
    np.testing.assert_array_equal(ask(robot, 1), expected[1])
    return said


@pytest.mark.parametrize(
    ("asks", "name"), [(False, name) for name in ANSWERS] + [(True, name) for name in REQUESTS]
)
def test_frames_in_clear_that_come_again_end_the_connection(
    plain: RunningServer,
    expected: list[Any],
    robot: Robot,
    in_the_middle: Stand,
    asks: bool,
    name: str,
) -> None:
    man = in_the_middle(plain.port, plain_frame)
    one = robot(man.address, **shown(plain))
    for number in (0, 1):
        np.testing.assert_array_equal(ask(one, number), expected[number])
    begun = len(logged(plain))
    if asks:
        man.ask = REQUESTS[name]
    else:
        man.answer = ANSWERS[name]
    said = judge(one, man, expected)
    if asks and name != "introduced-again":  # the server disconnects, and gives the reason
        assert "was replayed" in logged(plain)[begun:]
    assert any("is lost" in text for text in said), said
    if not asks:
        assert any("replayed" in text or "no message" in text for text in said), said


def test_a_conversation_that_is_sent_again_is_computed_no_second_time(
    plain: RunningServer, robot: Robot, in_the_middle: Stand
) -> None:
    man = in_the_middle(plain.port, plain_frame)
    one = robot(man.address, **shown(plain))
    for number in range(3):
        ask(one, number)
    before, begun = computed(plain), len(logged(plain))
    handshake, *frames = man.recordings[0].asked
    for waits in (True, False):  # for the first message
        with closing(socket.create_connection(("127.0.0.1", plain.port), 20.0)) as again:
            again.sendall(handshake)
            if waits:
                assert plain_frame(again).startswith(b"HT")
                assert kind_of(plain_frame(again)) == "welcome"
            with suppress(ConnectionError):
                for frame in frames:
                    again.sendall(frame)
                while again.recv(4096):
                    pass
        assert computed(plain) == before
    assert "was replayed" in logged(plain)[begun:]
    assert answers(one)


def test_tls_refuses_a_conversation_that_is_sent_again(
    serve: Serve, robot: Robot, in_the_middle: Stand
) -> None:
    server = serve()
    man = in_the_middle(server.port, tls_record)
    one = robot(man.address)
    for number in range(3):
        ask(one, number)
    before = computed(server)
    again = socket.create_connection(("127.0.0.1", server.port), 20.0)
    with closing(again), suppress(OSError):
        for record in man.recordings[0].asked:
            again.sendall(record)
        while again.recv(4096):
            pass
    assert computed(server) == before
    assert answers(one)


def test_a_welcome_that_was_recorded_introduces_nobody(
    plain: RunningServer, robot: Robot, in_the_middle: Stand
) -> None:
    man = in_the_middle(plain.port, plain_frame)
    ask(robot(man.address, **shown(plain)), 0)
    (recorded,) = of_kind(man.recordings[0].answered, "welcome")
    before = computed(plain)
    man.answer = lambda recording, frame: (recorded if kind_of(frame) == "welcome" else frame,)
    assert "is lost" in ask(robot(man.address, **shown(plain)), 1)
    assert computed(plain) == before


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
def test_a_server_is_taken_back_after_garbage(
    plain: RunningServer, robot: Robot, in_the_middle: Stand, kind: str
) -> None:
    man = in_the_middle(plain.port, plain_frame)
    one, failures = robot(man.address, **{**shown(plain), "timeout_s": 0.4}), list[str]()

    def is_served() -> bool:
        try:
            one.predict(seen(1))
        except RoboNeuronError as error:
            failures.append(error.code)
            return False
        return True

    wait_until(is_served, 30.0, "it is served")
    man.answer = GARBAGE[kind]
    # three deadlines without an answer replace the connection, whose greeting is garbage
    wait_until(lambda: not is_served() and len(failures) >= 5, 30.0, "garbage is noticed")
    man.honest()
    wait_until(is_served, BACK_S, "it is served again")
