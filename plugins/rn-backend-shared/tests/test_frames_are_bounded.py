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

from rn_backend_shared.channel import FrameChannel
from rn_backend_shared.frames import (
    HEADER_BYTES,
    MOST_ARRAY_BYTES,
    MOST_DOCUMENT_BYTES,
    VERSION,
    FrameKind,
    Header,
    VersionError,
    decode,
    encode,
    read_header,
)
from rn_backend_shared.plugin import BACKEND
from rn_backend_shared.session import READY, ModelSession, Welcome
from rn_backend_shared.wire import (
    HeldContext,
    from_answer,
    from_observation,
    to_answer,
    to_observation,
)
from rn_testing.fakes.backend import make_observation
from roboneuron import (
    ActionChunk,
    Ahead,
    ArmState,
    CameraCalibration,
    ForeignDataError,
    InvalidInputError,
    NotReadyError,
    Observation,
    PluginError,
    RoboNeuronError,
    UnsafeError,
)

SEEN = make_observation(BACKEND)
SMALL = replace(
    SEEN, frames={"primary": replace(SEEN.frames["primary"], image=np.zeros((4, 4, 3), np.uint8))}
)
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
    """A document after encoding and decoding."""
    frame = b"".join(encode(Header(FrameKind.REQUEST), document))
    return decode(read_header(frame[:HEADER_BYTES]), frame[HEADER_BYTES:])


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
    assert from_observation(replace(SEEN, ahead=ahead))["ahead"]["context"] is None


@pytest.mark.parametrize("field", ["position", "gripper"])
def test_a_state_that_is_not_finite_is_not_sent(field: str) -> None:
    assert SEEN.joints is not None
    bad = {
        "position": {"joints": replace(SEEN.joints, position=SEEN.joints.position * np.nan)},
        "gripper": {"gripper_open": float("inf")},
    }
    with pytest.raises(UnsafeError, match="not finite"):
        from_observation(replace(SEEN, **bad[field]))


def spoilt(change: Callable[[dict[str, Any]], object]) -> dict[str, Any]:
    document = from_observation(whole())
    change(document)
    return arrived(document)


@pytest.mark.parametrize(
    "change",
    [
        lambda d: d.pop("stamp_ns"),
        lambda d: d.update(stamp_ns=1 << 63),
        lambda d: d.update(stamp_ns=True),
        lambda d: d.update(instruction="x" * 20_000),
        lambda d: d.update(gripper_open="open"),
        lambda d: d["frames"]["primary"].update(image=np.zeros((4, 4, 3))),
        lambda d: d["frames"]["primary"].update(image=np.zeros((0, 4, 3), np.uint8)),
        lambda d: d["frames"]["primary"].update(image=np.zeros((4, 4), np.uint8)),
        lambda d: d.update(frames={f"c{i}": None for i in range(17)}),
        lambda d: d["joints"].__setitem__(1, np.zeros(3)),
        lambda d: d["joints"].__setitem__(2, d["joints"][2] * np.nan),
        lambda d: d["ee_pose"].__setitem__(1, np.zeros(3)),
        lambda d: d["ahead"].update(rows=ROWS * np.inf),
        lambda d: d["ahead"].update(committed_rows=5),
        lambda d: d["ahead"].update(committed_rows=1.0),
        lambda d: d["ahead"].update(step_s=0.0),
        lambda d: d["ahead"].update(state_ahead_s=-1.0),
        lambda d: d["ahead"].update(context=[1]),
        lambda d: d.update(arms=[]),
    ],
)
@pytest.mark.filterwarnings("ignore:invalid value")
def test_a_field_outside_the_contract_is_refused(
    change: Callable[[dict[str, Any]], object],
) -> None:
    with pytest.raises((ForeignDataError, InvalidInputError)):
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
    document = from_answer(ActionChunk(actions=ROWS, step_s=0.1)) | {field: value}
    with pytest.raises((ForeignDataError, RoboNeuronError)):
        to_answer(arrived(document))


def test_an_error_arrives_as_it_was() -> None:
    with pytest.raises(NotReadyError, match=r"^late wait$"):
        to_answer(arrived(from_answer(NotReadyError("late", hint="wait"))))
    with pytest.raises(PluginError, match="news"):
        to_answer(arrived({"error": "unheard_of", "message": "news", "hint": ""}))


@given(st.binary(max_size=200))
def test_any_bytes_are_a_frame_or_refused(data: bytes) -> None:
    padded = data[:HEADER_BYTES].ljust(HEADER_BYTES, b"\0")
    for head in (padded, Header(FrameKind.HELLO).pack()[:5] + padded[5:]):
        try:
            header = read_header(head)
            assert header.document_bytes <= MOST_DOCUMENT_BYTES
            assert header.array_bytes <= MOST_ARRAY_BYTES
        except ForeignDataError:
            pass
    for size in (0, len(data)):
        with suppress(ForeignDataError):
            decode(Header(FrameKind.REQUEST, document_bytes=size), data)


@given(st.data())
def test_a_damaged_frame_is_read_or_refused(drawn: st.DataObject) -> None:
    frame = bytearray(b"".join(encode(Header(FrameKind.REQUEST), from_observation(whole()))))
    document_end = HEADER_BYTES + read_header(frame[:HEADER_BYTES]).document_bytes
    for _ in range(drawn.draw(st.integers(1, 4))):
        place = drawn.draw(st.integers(0, document_end - 1))
        frame[place] = drawn.draw(st.integers(0, 255))
    try:
        header = read_header(frame[:HEADER_BYTES])
        to_observation(decode(header, frame[HEADER_BYTES : HEADER_BYTES + header.body_bytes]))
    except (ForeignDataError, RoboNeuronError):
        pass


@pytest.mark.parametrize(
    "text",
    [
        b"[[[[",
        b"[" * 50_000,
        b'[{"a": NaN}, []]',
        b'[{"a": {"$array": -1}}, []]',
        b'[{"a": {"$array": 0}}, [["|u1", [2]]]]',
        b'[{"a": 1}, [["O", [1]]]]',
        b'[{"a": 1}, [["|u1", [-1]]]]',
        b'[{"a": 1}, [["|u1", [9999999999, 9999999999, 9999999999]]]]',
        b'[{"a": 1}, [["|u1", [1, 1, 1, 1, 1]]]]',
        b'[{"a": ' + b"9" * 10_000 + b"}, []]",
        b"[[], []]",
        b"\xff\xfe",
    ],
)
def test_a_document_that_is_none_is_refused(text: bytes) -> None:
    with pytest.raises(ForeignDataError):
        decode(Header(FrameKind.REQUEST, document_bytes=len(text)), text + b"x")


def test_both_versions_are_named() -> None:
    head = bytearray(Header(FrameKind.HELLO).pack())
    head[4] = 9
    with pytest.raises(VersionError, match=f"version 9 .* version {VERSION}"):
        read_header(head)


def test_what_is_too_large_is_not_sent_and_not_received() -> None:
    with pytest.raises(ValueError, match="more than can be sent"):
        encode(Header(FrameKind.REQUEST), {"a": np.zeros(MOST_ARRAY_BYTES + 1, np.uint8)})
    with pytest.raises(ForeignDataError, match="more than allowed"):
        read_header(Header(FrameKind.REQUEST, array_bytes=MOST_ARRAY_BYTES + 1).pack())


@pytest.fixture
def ends() -> Iterator[tuple[FrameChannel, FrameChannel]]:
    """Two connected channels."""
    one, other = map(FrameChannel, socket.socketpair())
    yield one, other
    one.close()
    other.close()


def answer_to(header: Header, first: float = 0.0, **changed: int) -> list[bytes | memoryview]:
    rows = ROWS.copy()
    rows[:, 0] = first
    answer = Header(FrameKind.ANSWER, header.number, header.clock_ns)._replace(**changed)
    return encode(answer, from_answer(ActionChunk(actions=rows, step_s=0.1)))


def test_late_answers_are_dropped(ends: tuple[FrameChannel, FrameChannel]) -> None:
    here, there = ends
    session = ModelSession(here, Welcome(state=READY, pid=1))
    request = from_observation(SMALL)
    late = []
    for _ in range(2):
        with pytest.raises(TimeoutError):
            session.ask(request, time.monotonic() + 0.01)
        late.append(there.receive(time.monotonic() + 10.0).header)

    def serve() -> None:
        asked = there.receive(time.monotonic() + 10.0).header
        for parts in (answer_to(late[1], 0.1), answer_to(asked, 0.4), answer_to(late[0], 0.2)):
            there.send_parts(parts, 10.0)
        asked = there.receive(time.monotonic() + 10.0).header
        there.send_parts(answer_to(asked, 0.5), 10.0)

    thread = threading.Thread(target=serve)
    thread.start()
    for first in (0.4, 0.5):
        assert session.ask(request, time.monotonic() + 10.0).actions[0, 0] == first
    thread.join(10.0)


@pytest.mark.parametrize("changed", ["late twice", "number", "clock", "answered"])
def test_answers_that_nobody_waits_for_end_the_connection(
    ends: tuple[FrameChannel, FrameChannel], changed: str
) -> None:
    here, there = ends
    session = ModelSession(here, Welcome(state=READY, pid=1, number=1 << 60))
    request = from_observation(SMALL)
    with pytest.raises(TimeoutError):
        session.ask(request, time.monotonic() + 0.01)
    late = there.receive(time.monotonic() + 10.0).header
    assert late.number == (1 << 60) + 1

    def serve() -> None:
        asked = there.receive(time.monotonic() + 10.0).header
        first = {
            "late twice": [answer_to(late), answer_to(late)],
            "number": [answer_to(asked, number=asked.number + 1)],
            "clock": [answer_to(asked, clock_ns=late.clock_ns)],
            "answered": [answer_to(late), answer_to(asked), answer_to(asked)],
        }[changed]
        for parts in (*first, answer_to(asked)):
            there.send_parts(parts, 10.0)

    thread = threading.Thread(target=serve)
    thread.start()
    if changed == "answered":
        session.ask(request, time.monotonic() + 10.0)
    with pytest.raises(ForeignDataError, match="was replayed"):
        session.ask(request, time.monotonic() + 10.0)
    thread.join(10.0)


def test_a_server_that_leaves_questions_open_is_left(
    ends: tuple[FrameChannel, FrameChannel],
) -> None:
    here, there = ends
    session = ModelSession(here, Welcome(state=READY, pid=1))
    for _ in range(64):
        with pytest.raises(TimeoutError):
            session.ask({}, time.monotonic() + 0.001)
        there.receive(time.monotonic() + 10.0)
    with pytest.raises(ForeignDataError, match="64 requests without an answer"):
        session.ask({}, time.monotonic() + 1.0)


def test_time_left_is_told_and_not_a_time_of_day(ends: tuple[FrameChannel, FrameChannel]) -> None:
    here, there = ends
    with pytest.raises(TimeoutError):
        ModelSession(here, Welcome(state=READY, pid=1)).ask({}, time.monotonic() + 0.2)
    assert 0.0 < there.receive(time.monotonic() + 10.0).header.left_s <= 0.2


def test_a_connection_with_half_a_frame_is_of_no_more_use(
    ends: tuple[FrameChannel, FrameChannel],
) -> None:
    here, _ = ends
    session = ModelSession(here, Welcome(state=READY, pid=1))
    large = {"a": np.zeros(1 << 22, np.uint8)}
    with pytest.raises(TimeoutError):
        session.ask(large, time.monotonic() + 0.1)
    with pytest.raises(ConnectionError, match="in part"):
        session.ask({}, time.monotonic() + 0.1)
