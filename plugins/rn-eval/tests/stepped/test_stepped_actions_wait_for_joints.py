"""In stepped time an action is executed with joints that were measured after it was sent."""

from __future__ import annotations

import threading
from contextlib import ExitStack
from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from rn_eval_stepped.actions import SteppedActions
from rn_eval_stepped.world_clock import CLOSED_METRIC, END_PARAMETER, ENDED, SKIPPED
from roboneuron import ArmProfile, GripperProfile, JointCommand, JointSample, Pose
from roboneuron.feature import LimitedCommand
from roboneuron.modules.step_filters import ActionStep


class FakeControl:
    """What `SteppedActions` takes over of control."""

    def __init__(self) -> None:
        self.watched = SimpleNamespace(joints=None)
        self.action_ns, self.action_s, self.is_holding = 0, 0.0, True
        self.answer = self.send
        self.height_m = 0.3
        hand = GripperProfile(joint="hand", closed_position=0.0, open_position=0.04)
        arm = ArmProfile(name="", joints=(), base_link="base", tcp_link="tcp", gripper=hand)
        self.profile = SimpleNamespace(each_arm=[arm])
        self.values: dict[str, float] = {}
        self.status = SimpleNamespace(set_value=self.values.__setitem__, changed=threading.Event())
        self.executed: list[tuple[str, float]] = []
        self.told: list[list[float]] = []
        self.parameters: dict = {}
        self.node = SimpleNamespace(
            repeat=lambda period_s, look: setattr(self, "look", look),
            resources=ExitStack(),
            advertise=lambda type_, topic: SimpleNamespace(
                publish=lambda message: self.told.append(list(message.data))
            ),
            add_parameter=self.add_parameter,
        )
        self.actions = SteppedActions(self)  # type: ignore[arg-type]

    def act(self, source_ns: int) -> None:
        """An action that was sent at that time comes."""
        self.actions.act(ActionStep(source_ns=source_ns, read=cast("Any", None)), self.execute)

    def execute(self, step: ActionStep) -> None:
        self.executed.append((step.source_ns, self.clock()))
        self.answer()

    def poses(self, joints: JointSample) -> tuple[Pose, ...]:
        place = np.array([0.4, 0.0, self.height_m])
        return (Pose(position_m=place, quaternion_xyzw=np.array([0.0, 0.0, 0.0, 1.0])),)

    def add_parameter(self, name, value, take):
        self.parameters[name] = take
        return lambda: None

    def send(self) -> None:
        self.action_s += 1.0
        self.is_holding = False

    def refuse(self) -> None:
        """The limits let nothing through."""

    def hold(self) -> None:
        self.action_s += 1.0
        self.is_holding = True

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
    control.act(100)
    control.measure(100, 0.1)
    assert control.executed == []
    control.measure(101, 0.1)
    control.measure(102, 0.1)
    assert [executed for executed, _ in control.executed] == [100]


def test_time_is_that_of_the_commands():
    control = FakeControl()
    command = JointCommand(names=("a",), position=np.zeros(1), duration_s=0.1)
    for stamp_ns in (10, 20):
        control.act(stamp_ns)
        control.measure(stamp_ns + 1, 0.1)
        assert control.fixed_step_s == 0.1
        control.actions.note_limited(LimitedCommand(command=command))
    first, second = (now_s for _, now_s in control.executed)
    assert abs(second - first - 0.1) < 1e-9


def test_a_motion_that_begins_at_rest_has_nothing_before_it():
    control = FakeControl()
    before_s = control.clock()
    control.act(1)
    control.measure(2, 0.0)
    assert control.executed[0][1] - before_s > 1.0


def test_the_simulation_is_told_of_actions_that_move_nothing():
    control = FakeControl()
    told = []
    for number, answer in enumerate(
        (control.send, control.refuse, control.hold, control.hold, control.send), 1
    ):
        control.answer = answer
        control.act(number)
        control.measure(number + 1, 0.1)
        told.append(len(control.told))
    # the first hold is sent, the second one is not
    assert told == [0, 1, 1, 2, 2]
    assert {word for word, _ in control.told} == {SKIPPED}


def test_the_simulation_is_told_of_the_last_command():
    control = FakeControl()
    control.parameters[END_PARAMETER](7)
    assert control.told == [[ENDED, 7]]


def test_the_height_at_which_the_hand_closes_is_that_of_the_joints_then():
    control = FakeControl()
    control.measure(1, 0.0)
    told = []
    for height_m, opening_m in ((0.3, 0.04), (0.021, 0.0), (0.2, 0.0), (0.1, 0.04)):
        control.height_m = height_m
        command = JointCommand(names=("hand",), position=np.array([opening_m]), duration_s=0.1)
        control.actions.note_limited(LimitedCommand(command=command))
        told.append(control.values.get(CLOSED_METRIC))
    assert told == [None, 0.021, 0.021, 0.021]
