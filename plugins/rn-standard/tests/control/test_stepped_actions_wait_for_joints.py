"""In stepped time an action is executed with joints that were measured after it was sent."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from std_msgs.msg import Float64MultiArray

from rn_standard.control.stepped import SteppedActions
from roboneuron import JointCommand, JointSample
from roboneuron.node import LimitedCommand


class FakeControl:
    """What `SteppedActions` takes over of control."""

    def __init__(self) -> None:
        self.watched = SimpleNamespace(joints=None)
        self.on_limited: list = []
        self.action_ns = 0
        self.executed: list[tuple[str, float]] = []
        self.node = SimpleNamespace(repeat=lambda period_s, look: setattr(self, "look", look))
        self.actions = SteppedActions(self, self.execute)  # type: ignore[arg-type]

    def execute(self, message, info) -> None:
        self.executed.append((message, self.clock()))

    def measure(self, stamp_ns: int, velocity: float) -> None:
        self.watched.joints = JointSample(
            names=("a",),
            position=np.zeros(1),
            velocity=np.full(1, velocity),
            stamp_ns=stamp_ns,
        )
        self.look()


def test_an_action_waits_for_joints_that_are_newer():
    control = FakeControl()
    control.measure(100, 0.1)
    message = Float64MultiArray()
    control.actions.take(message, {"source_timestamp": 100})
    control.measure(100, 0.1)
    assert control.executed == []
    control.measure(101, 0.1)
    control.measure(102, 0.1)
    assert [executed for executed, _ in control.executed] == [message]


def test_time_is_that_of_the_commands():
    control = FakeControl()
    command = JointCommand(names=("a",), position=np.zeros(1), duration_s=0.1)
    for stamp_ns in (10, 20):
        control.actions.take(Float64MultiArray(), {"source_timestamp": stamp_ns})
        control.measure(stamp_ns + 1, 0.1)
        assert control.step_s(stamp_ns, 1e9) == 0.1
        for note in control.on_limited:
            note(LimitedCommand(command=command))
    first, second = (now_s for _, now_s in control.executed)
    assert abs(second - first - 0.1) < 1e-9
    assert control.action_ns == 20


def test_a_motion_that_begins_at_rest_has_nothing_before_it():
    control = FakeControl()
    before_s = control.clock()
    control.actions.take(Float64MultiArray(), {"source_timestamp": 1})
    control.measure(2, 0.0)
    assert control.executed[0][1] - before_s > 1.0
