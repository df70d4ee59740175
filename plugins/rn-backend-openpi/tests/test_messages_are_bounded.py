"""Received data is checked field by field against the bounds of the contract; everything else is
refused without harm.
"""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from websockets.server import ServerProtocol
from websockets.sync.server import ServerConnection

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


def test_an_observation_arrives_with_everything_that_the_contract_has() -> None:
    held: list[HeldContext] = []

    def recall(context: HeldContext) -> object:
        held.append(context)
        return context

    sent = from_observation(whole())
    assert pack(from_observation(to_observation(arrived(sent), recall))) == pack(sent)
    assert held == [HeldContext(7, 3)]
    entries = {"prompt", "observation/image", "observation/wrist_image", RESERVED}
    assert sent.keys() > entries


def test_a_chunk_arrives_as_it_was_with_metrics_that_are_no_numbers() -> None:
    chunk = ActionChunk(
        actions=ROWS,
        step_s=1 / 3,
        metrics={"tokens": 0.1, "unknown": float("nan")},
        note="grasping",
        conditioned_rows=2,
    )
    sent = from_answer(chunk, HeldContext(1, 2))
    told = to_answer(arrived(sent))
    assert (told.context, told.note, told.conditioned_rows) == (HeldContext(1, 2), "grasping", 2)
    assert pack(from_answer(told, HeldContext(1, 2))) == pack(sent)


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


class Peer(ServerConnection):
    """The server's end of a connection."""

    def asked(self) -> dict[str, Any]:
        """What the next message has at `RESERVED`."""
        found = unpack(self.recv(timeout=10.0, decode=False))
        assert isinstance(found, dict)
        return dict(found[RESERVED])

    def tell(self, *messages: dict[str, Any]) -> None:
        """Send messages."""
        for message in messages:
            self.send(pack(message))


@pytest.fixture
def ends() -> Iterator[tuple[PolicyConnection, Peer]]:
    """Both ends of a connection."""
    one, other = socket.socketpair()
    here = PolicyConnection(one, "ws://localhost/")
    there = Peer(
        other,
        ServerProtocol(max_size=MOST_BYTES),
        close_timeout=0.1,
        ping_interval=None,
        max_queue=1,
    )
    accepting = threading.Thread(target=there.handshake)
    accepting.start()
    here.open(time.monotonic() + 10.0)
    accepting.join(10.0)
    yield here, there
    here.close()
    there.close()


@contextmanager
def serving(serve: Callable[[], None]) -> Iterator[None]:
    """Run the server's part beside the client's."""
    thread = threading.Thread(target=serve)
    thread.start()
    yield
    thread.join(10.0)


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
    request = from_observation(SEEN)
    late = []
    for _ in range(2):
        with pytest.raises(TimeoutError):
            session.ask(request, time.monotonic() + 0.05)
        late.append(there.asked())

    def serve() -> None:
        asked = there.asked()
        there.tell(answer_to(late[1], 0.1), answer_to(asked, 0.4), answer_to(late[0], 0.2))
        there.tell(answer_to(there.asked(), 0.5))

    with serving(serve):
        for first in (0.4, 0.5):
            assert session.ask(request, time.monotonic() + 10.0).actions[0, 0] == first


@pytest.mark.parametrize("changed", ["late twice", "number", "clock", "answered"])
def test_answers_that_nobody_waits_for_end_the_connection(ends: Ends, changed: str) -> None:
    here, there = ends
    session = PolicySession(here, ServerDescription(state=READY, pid=1, number=1 << 60))
    request = from_observation(SEEN)
    with pytest.raises(TimeoutError):
        session.ask(request, time.monotonic() + 0.05)
    late = there.asked()
    assert late["number"] == (1 << 60) + 1

    def serve() -> None:
        asked = there.asked()
        first = {
            "late twice": [answer_to(late), answer_to(late)],
            "number": [answer_to(asked, number=asked["number"] + 1)],
            "clock": [answer_to(asked, clock_ns=late["clock_ns"])],
            "answered": [answer_to(late), answer_to(asked), answer_to(asked)],
        }[changed]
        there.tell(*first, answer_to(asked))

    with serving(serve):
        if changed == "answered":
            session.ask(request, time.monotonic() + 10.0)
        with pytest.raises(ForeignDataError, match="was replayed"):
            session.ask(request, time.monotonic() + 10.0)


def test_time_left_is_told_and_a_server_that_leaves_questions_open_is_left(ends: Ends) -> None:
    here, there = ends
    session = PolicySession(here, ServerDescription(state=READY, pid=1))
    for _ in range(64):
        with pytest.raises(TimeoutError):
            session.ask({}, time.monotonic() + 0.02)
        assert 0.0 < there.asked()["left_s"] <= 0.02, "a duration, no time of day"
    with pytest.raises(ForeignDataError, match="64 requests without an answer"):
        session.ask({}, time.monotonic() + 1.0)


def test_a_connection_with_half_a_message_is_of_no_more_use(ends: Ends) -> None:
    here, _ = ends
    session = PolicySession(here, ServerDescription(state=READY, pid=1))
    for _ in range(3):  # more than the server's end holds, so that it reads no further
        here.send(pack({}), time.monotonic() + 10.0)
    large = {"a": np.zeros(1 << 24, np.uint8)}
    with pytest.raises(TimeoutError):
        session.ask(large, time.monotonic() + 0.1)
    with pytest.raises(ConnectionError, match="in part"):
        session.ask({}, time.monotonic() + 0.1)


def test_a_message_in_pieces_arrives_whole_and_a_huge_one_ends_the_connection(ends: Ends) -> None:
    here, there = ends

    def pieces() -> Iterator[str]:
        yield "a"
        with pytest.raises(TimeoutError):
            here.receive(time.monotonic() + 0.05)
        there.ping()
        yield "b"

    there.send(pieces())
    assert here.receive(time.monotonic() + 10.0) == "ab"
    there.socket.sendall(b"\x82\x7f" + (MOST_BYTES + 1).to_bytes(8, "big"))
    with pytest.raises(ForeignDataError):
        here.receive(time.monotonic() + 10.0)
