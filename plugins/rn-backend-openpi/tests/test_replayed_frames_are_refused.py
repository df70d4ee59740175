"""A man in the middle records the messages of a robot and a policy server, and replays them: the
arm executes none of them, the model computes none again, and the connection ends with an error that
says so.
"""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from middle_man import Cut, MiddleMan, Recording, message_of, plain_frame, tls_record
from policy_servers import Robot, RunningServer, Serve, answers, robot_of, seen

from rn_backend_openpi.backend import PolicyBackend
from rn_backend_openpi.connection import PolicyConnection
from rn_backend_openpi.description import ServerDescription
from rn_backend_openpi.messages import RESERVED
from rn_backend_openpi.security import authorization
from rn_backend_openpi.session import receive
from rn_backend_openpi.wire import pack
from rn_testing.waiting import wait_until
from roboneuron import NotReadyError

pytestmark = pytest.mark.timeout(200)


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


ANSWERS: dict[str, Callable[[Recording, bytes], Sequence[bytes]]] = {
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
REQUESTS: dict[str, Callable[[Recording, bytes], Sequence[bytes]]] = {
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


@pytest.mark.parametrize("runs", [1, 2], ids=["another-connection", "another-run"])
def test_answers_of_another_connection_or_run_are_refused(
    plain: RunningServer, expected: list[Any], robot: Robot, in_the_middle: Stand, runs: int
) -> None:
    man = in_the_middle(plain.port, plain_frame)
    first = robot(man.address, **shown(plain))
    for number in range(5):
        ask(first, number)
    first.close()
    recorded = of_kind(man.recordings[0].answered, "answer")
    assert len(recorded) == 5
    if runs == 2:
        plain.end()
        plain.start()
        man = in_the_middle(plain.port, plain_frame)
    second = robot(man.address, **shown(plain))

    def other(recording: Recording, frame: bytes) -> Sequence[bytes]:
        place = len(of_kind(recording.answered, "answer"))
        return (recorded[place],) if kind_of(frame) == "answer" else (frame,)

    man.answer = other
    said = judge(second, man, expected)
    assert "was replayed" in said[0]


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


def test_a_request_of_another_connection_is_computed_no_second_time(
    plain: RunningServer, robot: Robot, in_the_middle: Stand
) -> None:
    man = in_the_middle(plain.port, plain_frame)
    first, second = (robot(man.address, **shown(plain)) for _ in range(2))
    for number in range(3):
        ask(first, number)
        ask(second, number)
    recorded = of_kind(man.recordings[0].asked, "request")[-1]
    before = computed(plain)
    man.ask = lambda recording, frame: (recorded,)
    assert "is lost" in ask(second, 3)
    man.honest()
    assert computed(plain) == before
    wait_until(lambda: answers(second), 20.0)


@pytest.mark.exhaustive
def test_swapped_answers_are_late_and_dropped(
    plain: RunningServer, expected: list[Any], robot: Robot, in_the_middle: Stand
) -> None:
    man = in_the_middle(plain.port, plain_frame)
    one = robot(man.address, **{**shown(plain), "timeout_s": 1.0})
    held: list[bytes] = []

    def swap(recording: Recording, frame: bytes) -> Sequence[bytes]:
        if not held:
            held.append(frame)
            return ()
        return (frame, held.pop())

    man.answer = swap
    for number in (1, 2, 3, 4):
        found = ask(one, number)
        if number % 2:
            assert "gave no answer" in found
        else:
            np.testing.assert_array_equal(found, expected[number])
    assert len(man.recordings) == 1, "late answers are no reason to hang up"


@pytest.mark.exhaustive
def test_tls_refuses_records_that_come_again(
    serve: Serve, robot: Robot, in_the_middle: Stand
) -> None:
    server = serve()
    direct = robot(server.address, **RAW)
    expected = [ask(direct, number) for number in range(5)]
    for asks in (False, True):
        for name in ("twice", "old-before-it", "swapped"):
            man = in_the_middle(server.port, tls_record)
            check_tls(server, robot(man.address, **RAW), man, expected, asks=asks, name=name)


def check_tls(
    server: RunningServer,
    one: PolicyBackend,
    man: MiddleMan,
    expected: Sequence[Any],
    *,
    asks: bool,
    name: str,
) -> None:
    for number in (0, 1):
        np.testing.assert_array_equal(ask(one, number), expected[number])
    held: list[bytes] = []

    def replay(recording: Recording, record: bytes) -> Sequence[bytes]:
        if name != "swapped":
            # without an earlier record, as after a new connection, this one passes
            earlier = list(recording.asked if asks else recording.answered)[-1:]
            return (record, record) if name == "twice" else (*earlier, record)
        if not held:
            held.append(record)
            return ()
        return (record, held.pop())

    before = computed(server)
    if asks:
        man.ask = replay
    else:
        man.answer = replay
    said = judge(one, man, expected)
    assert any("is lost" in text for text in said) or name == "swapped", said
    assert said
    one.close()
    # those that were answered or lost in transit, and two at the end
    assert computed(server) - before <= 3 + 4


@pytest.mark.exhaustive
@pytest.mark.parametrize("asks", [False, True], ids=["answers", "requests"])
def test_the_first_connection_after_records_came_twice_is_the_last(
    serve: Serve, robot: Robot, in_the_middle: Stand, asks: bool
) -> None:
    man = in_the_middle(serve().port, tls_record)
    one = robot(man.address, **RAW)
    assert answers(one)
    if asks:
        man.ask = twice
    else:
        man.answer = twice
    wait_until(lambda: not answers(one) and len(man.recordings) > 3, 30.0, "it tries and tries")
    man.honest()
    tried = len(man.recordings)
    wait_until(lambda: answers(one), 20.0, "it is answered again")
    assert len(man.recordings) <= tried + 1, "nothing is left of those before"


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


def test_the_first_number_is_drawn_for_each_connection(plain: RunningServer) -> None:
    token = (plain.folder / "token").read_text().strip()
    numbers = set()
    for _ in range(3):
        connected = socket.create_connection(("127.0.0.1", plain.port), 20.0)
        headers = {"Authorization": authorization(token)}
        until_s = time.monotonic() + 10.0
        with closing(PolicyConnection(connected, "ws://localhost/", headers)) as connection:
            connection.open(until_s)
            welcome = ServerDescription.of(receive(connection, until_s))
            numbers.add(welcome.number)
            skipped = {"number": welcome.number + 2, "clock_ns": 0, "left_s": 5.0}
            connection.send(pack({RESERVED: skipped}), until_s)
            assert "was replayed" in str(connection.receive(until_s))
            with pytest.raises(ConnectionError, match="closed"):
                connection.receive(until_s)
    assert len(numbers) == 3
