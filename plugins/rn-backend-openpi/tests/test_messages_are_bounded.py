"""Received data is checked field by field against the bounds of the contract; everything else is
refused without harm.
"""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from websockets.server import ServerProtocol

from rn_backend_openpi.connection import PolicyConnection
from rn_backend_openpi.description import PROTOCOL, READY, ServerDescription
from rn_backend_openpi.messages import (
    RESERVED,
    HeldContext,
    from_answer,
    from_observation,
    to_answer,
    to_observation,
)
from rn_backend_openpi.plugin import SHARED
from rn_backend_openpi.session import PolicySession
from rn_backend_openpi.wire import MOST_BYTES, pack, unpack
from rn_testing.fakes.backend import make_observation
from roboneuron import (
    ActionChunk,
    Ahead,
    ArmState,
    CameraCalibration,
    ConfigurationError,
    ForeignDataError,
    InvalidInputError,
    NotReadyError,
    Observation,
    PluginError,
    RoboNeuronError,
    UnsafeError,
)

SEEN = make_observation(SHARED)
SMALL = replace(
    SEEN, frames={"primary": replace(SEEN.frames["primary"], image=np.zeros((4, 4, 3), np.uint8))}
)
assert SEEN.joints is not None
JOINTS = SEEN.joints.position
ROWS = np.tile([0.01, 0.0, 0.0, 0.0, 0.0, 0.1, 0.5], (4, 1))


def whole() -> Observation:
    """An observation with all fields of the contract."""
    assert SEEN.ee_pose is not None
    assert SEEN.joints is not None
    calibration = CameraCalibration(
        intrinsics=np.eye(3), mount="left/tcp", T_mount_camera=np.eye(4)
    )
    frames = {
        "primary": replace(SEEN.frames["primary"], calibration=calibration),
        "wrist": SEEN.frames["primary"],
    }
    ahead = Ahead(
        rows=ROWS,
        committed_rows=2,
        step_s=0.1,
        context=HeldContext(7, 3),
        context_row=1,
        state_ahead_s=0.25,
    )
    arms = {"left": ArmState(ee_pose=SEEN.ee_pose, gripper_open=0.25)}
    joints = replace(SEEN.joints, velocity=np.zeros(len(SEEN.joints.names)))
    return replace(SEEN, frames=frames, ahead=ahead, arms=arms, joints=joints)


def arrived(document: dict[str, Any]) -> dict[str, Any]:
    """A message after encoding and decoding."""
    found = unpack(pack(document))
    assert isinstance(found, dict)
    return {str(key): value for key, value in found.items()}


def same(one: object, other: object) -> bool:
    """True if equal in every field, arrays by their bytes."""
    if isinstance(one, np.ndarray):
        return isinstance(other, np.ndarray) and one.tobytes() == other.tobytes()
    if isinstance(one, dict):
        assert isinstance(other, dict)
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    fields = getattr(one, "__dataclass_fields__", None)
    if fields is None:
        return one == other
    return all(same(getattr(one, name), getattr(other, name)) for name in fields)


def test_an_observation_arrives_with_everything_that_the_contract_has() -> None:
    held: list[HeldContext] = []

    def recall(context: HeldContext) -> object:
        held.append(context)
        return context

    observation = whole()
    assert same(to_observation(arrived(from_observation(observation)), recall), observation)
    assert held == [HeldContext(7, 3)]


def test_a_chunk_arrives_as_it_was_with_metrics_that_are_no_numbers() -> None:
    chunk = ActionChunk(
        actions=ROWS,
        step_s=1 / 3,
        metrics={"tokens": 0.1, "unknown": float("nan")},
        note="grasping",
        conditioned_rows=2,
    )
    told = to_answer(arrived(from_answer(chunk, HeldContext(1, 2))))
    assert told.context == HeldContext(1, 2)
    assert np.isnan(told.metrics["unknown"])
    assert same(replace(told, metrics={}, context=None), replace(chunk, metrics={}))


def test_a_context_of_this_process_is_not_sent() -> None:
    ahead = Ahead(rows=ROWS, committed_rows=0, step_s=0.1, context=object())
    assert from_observation(replace(SEEN, ahead=ahead))[RESERVED]["ahead"]["context"] is None


@pytest.mark.parametrize("field", ["position", "gripper"])
def test_a_state_that_is_not_finite_is_not_sent(field: str) -> None:
    assert SEEN.joints is not None
    bad = {
        "position": {"joints": replace(SEEN.joints, position=SEEN.joints.position * np.nan)},
        "gripper": {"gripper_open": float("inf")},
    }
    with pytest.raises(UnsafeError, match="non-finite"):
        from_observation(replace(SEEN, **bad[field]))


def spoilt(change: Callable[[dict[str, Any]], object]) -> dict[str, Any]:
    document = from_observation(whole())
    change(document)
    return arrived(document)


@pytest.mark.parametrize(
    "change",
    [
        lambda d: d.pop("prompt"),
        lambda d: d[RESERVED].update(stamp_ns=1 << 63),
        lambda d: d[RESERVED].update(stamp_ns=True),
        lambda d: d.update(prompt="x" * 20_000),
        lambda d: d.update({"observation/gripper_open": "open"}),
        lambda d: d.update({"observation/image": np.zeros((4, 4, 3))}),
        lambda d: d.update({"observation/image": np.zeros((0, 4, 3), np.uint8)}),
        lambda d: d.update({"observation/image": np.zeros((4, 4), np.uint8)}),
        lambda d: d.update({f"observation/c{i}_image": None for i in range(17)}),
        lambda d: d[RESERVED].update(frames={f"c{i}": None for i in range(17)}),
        lambda d: d.update({"observation/joint_position": np.zeros(3)}),
        lambda d: d.update({"observation/joint_velocity": JOINTS * np.nan}),
        lambda d: d.update({"observation/joint_velocity": JOINTS[:2]}),
        lambda d: d.update({"observation/joint_names": ["a", "a"]}),
        lambda d: d.update({"observation/joint_names": ["a"] * 1000}),
        lambda d: d.update({"observation/joint_names": "ab"}),
        lambda d: d.update({"observation/joint_position": JOINTS * np.nan}),
        lambda d: d.update({"observation/ee_pose": np.full(7, np.inf)}),
        lambda d: d.update({"observation/left/ee_pose": np.zeros(3)}),
        lambda d: d.update({"observation/gripper_open": np.zeros(2)}),
        lambda d: d.update({"observation/ee_pose": np.zeros(7)}),
        lambda d: d[RESERVED].update(joints_stamp_ns=0.5),
        lambda d: d[RESERVED].update(arm_stamps_ns=[]),
        lambda d: d[RESERVED].update(frames={"primary": {"calibration": [1]}}),
        lambda d: d.update({RESERVED: []}),
        lambda d: d[RESERVED]["ahead"].update(rows=ROWS * np.inf),
        lambda d: d[RESERVED]["ahead"].update(committed_rows=5),
        lambda d: d[RESERVED]["ahead"].update(committed_rows=1.0),
        lambda d: d[RESERVED]["ahead"].update(step_s=0.0),
        lambda d: d[RESERVED]["ahead"].update(state_ahead_s=-1.0),
        lambda d: d[RESERVED]["ahead"].update(context=[1]),
    ],
)
@pytest.mark.filterwarnings("ignore:invalid value")
def test_a_field_outside_the_contract_is_refused(
    change: Callable[[dict[str, Any]], object],
) -> None:
    with pytest.raises((ForeignDataError, InvalidInputError, UnsafeError)):
        to_observation(spoilt(change))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("actions", ROWS * np.nan),
        ("actions", ROWS[:, :6]),
        ("step_s", 0.0),
        ("conditioned_rows", 9),
        ("metrics", [["a"], np.zeros(2)]),
        ("space", ["no_space", 0.0, [["x", "m", "", ""]] * 7]),
        ("context", [1.5, 2]),
        ("note", None),
    ],
)
@pytest.mark.filterwarnings("ignore:invalid value")
def test_a_chunk_outside_the_contract_is_refused(field: str, value: object) -> None:
    document = from_answer(ActionChunk(actions=ROWS, step_s=0.1))
    (document if field in document else document[RESERVED])[field] = value
    with pytest.raises((ForeignDataError, RoboNeuronError)):
        to_answer(arrived(document))


def test_an_error_arrives_as_it_was() -> None:
    with pytest.raises(NotReadyError, match=r"^late wait$"):
        to_answer(arrived(from_answer(NotReadyError("late", hint="wait"))))
    with pytest.raises(PluginError, match="news"):
        to_answer({RESERVED: {"error": "unheard_of", "message": "news", "hint": ""}})


@given(st.data())
def test_a_damaged_message_is_read_or_refused(drawn: st.DataObject) -> None:
    message = bytearray(pack(from_observation(replace(whole(), frames=SMALL.frames))))
    for _ in range(drawn.draw(st.integers(1, 4))):
        place = drawn.draw(st.integers(0, len(message) - 1))
        message[place] = drawn.draw(st.integers(0, 255))
    with suppress(ForeignDataError, RoboNeuronError):
        to_observation(unpack(bytes(message)))


@pytest.mark.parametrize(
    ("own", "told"),
    [
        ({"protocol": PROTOCOL + 1}, f"version {PROTOCOL + 1} .* version {PROTOCOL}"),
        ({}, "version None"),
    ],
)
def test_a_server_of_another_version_is_named(own: object, told: str) -> None:
    with pytest.raises(ConfigurationError, match=told):
        ServerDescription.of({RESERVED: own})


class Peer:
    """The server's end of a connection, as the library speaks it."""

    def __init__(self, plain: socket.socket) -> None:
        self._plain, self._protocol = plain, ServerProtocol(max_size=MOST_BYTES)

    def _next(self) -> Any:
        while not (events := self._protocol.events_received()):
            data = self._plain.recv(1 << 16)
            self._protocol.receive_data(data)
        return events[0]

    def _flush(self) -> None:
        for data in self._protocol.data_to_send():
            self._plain.sendall(data)

    def accept(self) -> None:
        """Do the handshake."""
        self._protocol.send_response(self._protocol.accept(self._next()))
        self._flush()

    def receive(self) -> dict[str, Any]:
        """What the next message has at `RESERVED`."""
        found = unpack(bytes(self._next().data))
        assert isinstance(found, dict)
        return dict(found[RESERVED])

    def send(self, message: dict[str, Any]) -> None:
        """Send a message."""
        self._protocol.send_binary(pack(message))
        self._flush()


@pytest.fixture
def ends() -> Iterator[tuple[PolicyConnection, Peer]]:
    """Both ends of a connection."""
    one, other = socket.socketpair()
    here, there = PolicyConnection(one, "ws://localhost/"), Peer(other)
    accepting = threading.Thread(target=there.accept)
    accepting.start()
    here.open(time.monotonic() + 10.0)
    accepting.join(10.0)
    yield here, there
    here.close()
    other.close()


Ends = tuple[PolicyConnection, Peer]


def answer_to(own: dict[str, Any], first: float = 0.0, **changed: int) -> dict[str, Any]:
    rows = ROWS.copy()
    rows[:, 0] = first
    answer = from_answer(ActionChunk(actions=rows, step_s=0.1))
    told = {key: own[key] for key in ("number", "clock_ns")}
    return {**answer, RESERVED: {**answer[RESERVED], **told, **changed}}


def test_late_answers_are_dropped(ends: Ends) -> None:
    here, there = ends
    session = PolicySession(here, ServerDescription(state=READY, pid=1))
    request = from_observation(SMALL)
    late = []
    for _ in range(2):
        with pytest.raises(TimeoutError):
            session.ask(request, time.monotonic() + 0.05)
        late.append(there.receive())

    def serve() -> None:
        asked = there.receive()
        for answer in (answer_to(late[1], 0.1), answer_to(asked, 0.4), answer_to(late[0], 0.2)):
            there.send(answer)
        there.send(answer_to(there.receive(), 0.5))

    thread = threading.Thread(target=serve)
    thread.start()
    for first in (0.4, 0.5):
        assert session.ask(request, time.monotonic() + 10.0).actions[0, 0] == first
    thread.join(10.0)


@pytest.mark.parametrize("changed", ["late twice", "number", "clock", "answered"])
def test_answers_that_nobody_waits_for_end_the_connection(ends: Ends, changed: str) -> None:
    here, there = ends
    session = PolicySession(here, ServerDescription(state=READY, pid=1, number=1 << 60))
    request = from_observation(SMALL)
    with pytest.raises(TimeoutError):
        session.ask(request, time.monotonic() + 0.05)
    late = there.receive()
    assert late["number"] == (1 << 60) + 1

    def serve() -> None:
        asked = there.receive()
        first = {
            "late twice": [answer_to(late), answer_to(late)],
            "number": [answer_to(asked, number=asked["number"] + 1)],
            "clock": [answer_to(asked, clock_ns=late["clock_ns"])],
            "answered": [answer_to(late), answer_to(asked), answer_to(asked)],
        }[changed]
        for answer in (*first, answer_to(asked)):
            there.send(answer)

    thread = threading.Thread(target=serve)
    thread.start()
    if changed == "answered":
        session.ask(request, time.monotonic() + 10.0)
    with pytest.raises(ForeignDataError, match="was replayed"):
        session.ask(request, time.monotonic() + 10.0)
    thread.join(10.0)


def test_a_server_that_leaves_questions_open_is_left(ends: Ends) -> None:
    here, there = ends
    session = PolicySession(here, ServerDescription(state=READY, pid=1))
    for _ in range(64):
        with pytest.raises(TimeoutError):
            session.ask({}, time.monotonic() + 0.02)
        there.receive()
    with pytest.raises(ForeignDataError, match="64 requests without an answer"):
        session.ask({}, time.monotonic() + 1.0)


def test_time_left_is_told_and_not_a_time_of_day(ends: Ends) -> None:
    here, there = ends
    with pytest.raises(TimeoutError):
        PolicySession(here, ServerDescription(state=READY, pid=1)).ask({}, time.monotonic() + 0.2)
    assert 0.0 < there.receive()["left_s"] <= 0.2


def test_a_connection_with_half_a_message_is_of_no_more_use(ends: Ends) -> None:
    here, _ = ends
    session = PolicySession(here, ServerDescription(state=READY, pid=1))
    large = {"a": np.zeros(1 << 22, np.uint8)}
    with pytest.raises(TimeoutError):
        session.ask(large, time.monotonic() + 0.1)
    with pytest.raises(ConnectionError, match="in part"):
        session.ask({}, time.monotonic() + 0.1)


def test_a_message_in_pieces_arrives_whole_and_a_huge_one_ends_the_connection(ends: Ends) -> None:
    here, there = ends
    there._protocol.send_text(b"a", fin=False)
    there._flush()
    with pytest.raises(TimeoutError):
        here.receive(time.monotonic() + 0.05)
    there._protocol.send_ping(b"")
    there._protocol.send_continuation(b"b", fin=True)
    there._flush()
    assert here.receive(time.monotonic() + 10.0) == "ab"
    there._plain.sendall(b"\x82\x7f" + (MOST_BYTES + 1).to_bytes(8, "big"))
    with pytest.raises(ForeignDataError):
        here.receive(time.monotonic() + 10.0)
