"""In stepped time rows and predictions follow the simulation, not the wall clock."""

from __future__ import annotations

import threading
import time
from contextlib import ExitStack
from types import SimpleNamespace

import numpy as np
import pytest
from std_msgs.msg import Float64MultiArray

from rn_eval_stepped.chunks import SteppedChunks
from rn_eval_stepped.world_clock import FREE, ROWS_METRIC, TURN_METRIC, TURN_PARAMETER
from roboneuron import ActionChunk, Frame, Observation
from roboneuron.modules.inference.execution import Bounds

MOVING, WAITING, RESTING = 0, 1, 3


class FakeNode:
    """What the executor asks of a module's node."""

    def __init__(self) -> None:
        self.resources = ExitStack()
        self.values: dict[str, object] = {}
        self.status = SimpleNamespace(set_value=self.values.__setitem__, changed=threading.Event())
        self.parameters: dict[str, object] = {}

    def subscribe(self, message_type, topic, callback):
        self.tell = callback

    def add_parameter(self, name, value, take):
        self.parameters[name] = take
        return lambda: None


@pytest.fixture
def node() -> FakeNode:
    return FakeNode()


@pytest.fixture
def chunks(node: FakeNode) -> SteppedChunks:
    return SteppedChunks(Bounds(first_s=10.0), node)  # type: ignore[arg-type]


def told(node: FakeNode, phase: int, count: int, since_ns: int = 5, time_s: float = 0.0) -> None:
    node.tell(Float64MultiArray(data=[float(v) for v in (phase, count, 0, since_ns, time_s)]))


def seen(stamp_ns: int) -> Observation:
    image = np.zeros((8, 8, 3), np.uint8)
    frame = Frame(camera="front", image=image, stamp_ns=stamp_ns, frame_id="front")
    return Observation(frames={"primary": frame}, instruction="go", stamp_ns=stamp_ns)


def answer(chunks: SteppedChunks, rows: int) -> None:
    prediction = chunks.begin(seen(time.time_ns()), time.time_ns())
    chunk = ActionChunk(actions=np.zeros((rows, 7)), step_s=0.1)
    assert chunks.answer(prediction, chunk, time.time_ns()) == "accepted"


def play(chunks: SteppedChunks) -> bool:
    return chunks.play(time.monotonic(), time.time_ns()) is not None


def test_a_row_follows_when_the_one_before_was_carried_out(node, chunks):
    assert not chunks.wants_prediction(0.0)  # no simulation is there
    told(node, RESTING, 4)
    assert chunks.wants_prediction(0.0)
    answer(chunks, 2)
    assert play(chunks)
    assert not play(chunks)
    told(node, MOVING, 4)
    assert not play(chunks)
    told(node, WAITING, 5)
    assert play(chunks)
    assert not chunks.wants_prediction(0.0)
    told(node, WAITING, 6)
    assert chunks.wants_prediction(0.0)


def wait(chunks: SteppedChunks) -> bool:
    return chunks.wait_until_wanted(threading.Event(), 0.02)


def test_turns_are_of_one_row_and_reported(node, chunks):
    told(node, RESTING, 0)
    turn = node.parameters[TURN_PARAMETER]
    turn(0)
    assert not wait(chunks)
    turn(1)
    assert wait(chunks)
    answer(chunks, 2)
    assert play(chunks)
    told(node, WAITING, 1)
    assert not play(chunks)
    assert not wait(chunks)
    assert node.values == {TURN_METRIC: 1, ROWS_METRIC: 1}
    turn(2)
    assert play(chunks)
    assert not wait(chunks)
    assert node.values == {TURN_METRIC: 2, ROWS_METRIC: 2}
    assert node.status.changed.is_set()
    turn(FREE)
    told(node, WAITING, 2)
    assert wait(chunks)


def test_a_failed_prediction_ends_a_turn_without_a_row(node, chunks):
    told(node, RESTING, 0)
    node.parameters[TURN_PARAMETER](1)
    assert wait(chunks)
    chunks.begin(seen(time.time_ns()), time.time_ns())
    chunks.drop()
    assert not wait(chunks)
    assert node.values == {TURN_METRIC: 1, ROWS_METRIC: 0}


def test_a_turn_lasts_until_there_are_images(node, chunks):
    told(node, RESTING, 0)
    node.parameters[TURN_PARAMETER](1)
    assert wait(chunks)
    assert wait(chunks)
    assert node.values == {}


def test_only_what_was_measured_since_it_stands_is_admitted(node, chunks):
    told(node, WAITING, 1, since_ns=100)
    assert not chunks.admits(seen(100))
    assert chunks.admits(seen(101))
    told(node, MOVING, 1, since_ns=100)
    assert not chunks.admits(seen(101))


def test_a_policy_sees_simulated_stamps(node, chunks):
    stamps = []
    for wall_ns in (10**15, 7 * 10**15):
        told(node, WAITING, 1, time_s=2.5)
        stamps.append(chunks.as_seen(seen(wall_ns)).frames["primary"].stamp_ns)
    assert stamps[0] == stamps[1]
    told(node, WAITING, 2, time_s=2.6)
    assert chunks.as_seen(seen(10**15)).stamp_ns - stamps[0] == 100_000_000
