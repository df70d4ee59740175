"""move_ee, move_joints and place on an arm in computation: the grip that is sent, and what the
answers say of it.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import anyio
import numpy as np
import pytest

from roboneuron.config import LimitsConfig
from roboneuron.contract import GripperProfile, JointSample, Pose, RobotProfile
from roboneuron.errors import InvalidInputError, NotReadyError, RefusedError, StateError
from roboneuron.gate.motion.joint_space import JointLimit
from roboneuron.modules.report import Report
from roboneuron.server import clock
from roboneuron.server.call_chain import SimulatedContext
from roboneuron.server.motion_gate import GateRequest, TimedCommand
from roboneuron.server.verdict import Sent, Verdict
from roboneuron.tools.arm import grip, joints
from roboneuron.tools.arm.ee_move import MoveEndEffector
from roboneuron.tools.arm.end_effector import EndEffectorMover
from roboneuron.tools.arm.grip_height import GripHeight
from roboneuron.tools.arm.joint_goals import MoveJoints
from roboneuron.tools.arm.joints import JointMover
from roboneuron.tools.arm.measured import SpeedMeter
from roboneuron.tools.arm.options import ArmToolsOptions
from roboneuron.tools.arm.place_plans import PlaceArguments
from roboneuron.tools.arm.placing import Placer

PROFILE = RobotProfile(
    name="arm",
    arm_joints=("j1",),
    gripper=GripperProfile(joint="finger", closed_position=0.0, open_position=0.04),
)
OBJECT_M, TABLE_M = 0.02, 0.1


class Arm:
    """Time, an arm that does what it is told at once, and an object that its hand closes around."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.place = np.array([0.4, 0.0, TABLE_M])
        self.joint, self.commanded, self.object_m = 0.0, 1.0, OBJECT_M
        self.grips: list[float] = []
        self.highest_m = TABLE_M
        self.listeners: list[Callable[[float], object]] = []
        self.speeds = SpeedMeter()
        self.slips_at_s = float("inf")
        self.pause_s = 0.0
        """Time that passes before each move."""
        self.wraps = False
        """It measures within half a turn."""
        self.max_duration_s = 120.0
        self.phase = "running"
        self.has_hand = True

    def monotonic(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds

    def finger_m(self) -> float:
        blocked_m = self.object_m if self.now_s < self.slips_at_s else 0.0
        return max(self.commanded * 0.04, blocked_m)

    def joints(self, exposed: Any, timeout_s: float) -> JointSample | None:
        if self.phase != "running":
            return None
        if not self.has_hand:
            return JointSample(names=("j1",), position=np.array([self.joint]))
        return JointSample(names=("j1", "finger"), position=np.array([self.joint, self.finger_m()]))

    def newest_joints(self, exposed: Any) -> JointSample | None:
        return self.joints(exposed, 0.0)

    def wait(self, timeout_s: float, newer_than_ns: int = 0) -> Pose:
        return Pose(position_m=self.place.copy(), quaternion_xyzw=np.array([0.0, 0.0, 0.0, 1.0]))

    def close_hand(self) -> None:
        """As a policy does."""
        for self.commanded in (1.0, 0.0):
            for listener in self.listeners:
                listener(float(self.place[2]))

    def check_free(self, exposed: Any) -> None: ...

    def open(self) -> None: ...

    def slowdown(self, request: GateRequest) -> float:
        return 1.0

    def joint_limits(self, exposed: Any) -> Any:
        return {}  # none beyond those that the mover was made with

    def play(
        self,
        exposed: Any,
        request: GateRequest,
        commands: Iterable[TimedCommand],
        *,
        total_s: float,
        timeout_s: float,
        halt: threading.Event,
        details: Callable[[], str] = lambda: "",
    ) -> Sent:
        self.now_s += self.pause_s
        began_s, sent = self.now_s, 0
        for command in commands:
            if command.message is not None:
                sent += 1
                self._follow(command.message)
            self.now_s = max(self.now_s + 0.01, command.due_s)
        verdict = Verdict(allowed=True)
        return Sent(verdict=verdict, messages=sent, subscribers=1, duration_s=self.now_s - began_s)

    def _follow(self, message: Any) -> None:
        if hasattr(message, "points"):
            targets = dict(zip(message.joint_names, message.points[0].positions, strict=True))
            self.joint = targets.get("j1", self.joint)
            if self.wraps:
                self.joint = math.remainder(self.joint, 2.0 * math.pi)
            self.commanded = targets.get("finger", self.commanded * 0.04) / 0.04
            return
        self.place = self.place + np.array(message.data[:3])
        self.highest_m = max(self.highest_m, float(self.place[2]))
        self.commanded = message.data[6]
        self.grips.append(message.data[6])

    @property
    def host(self) -> Any:
        def view(kind: str) -> Any:
            metrics = {"gripper_commanded": f"{self.commanded:g}"} if self.has_hand else {}
            detail = {} if self.has_hand else {"no_gripper": "true"}
            report = Report(metrics=metrics, detail=detail, note="")
            return SimpleNamespace(report=report, phase=self.phase)

        modules = SimpleNamespace(view=view, require_running=lambda kind: None)
        return SimpleNamespace(
            modules=modules,
            clock=lambda namespace: clock.RobotClock(),
            loop=SimpleNamespace(limits=LimitsConfig()),
            config=SimpleNamespace(namespace="arm", robot=SimpleNamespace(name="arm")),
            gate=self,
        )


CONTEXT: Any = SimpleNamespace(who="agent", role="operator", simulated=False)
LIMIT = JointLimit(lower=-1.0, upper=1.0, velocity=1.0, acceleration=1.0)


@pytest.fixture
def arm(monkeypatch: pytest.MonkeyPatch) -> Arm:
    arm = Arm()

    async def run(work: Callable[[Any], Any], **more: Any) -> Any:
        return work(lambda _: None)

    CONTEXT.run = run
    for module in (grip, joints, clock):
        monkeypatch.setattr(module, "time", arm)
    return arm


def exposed() -> Any:
    return SimpleNamespace(
        robot="arm", namespace="arm", profile=PROFILE, endpoint=SimpleNamespace(name="ee")
    )


def mover(arm: Arm) -> EndEffectorMover:
    tcp: Any = arm
    return EndEffectorMover(exposed(), PROFILE, arm.host, ArmToolsOptions(), {"": tcp})


def move(arm: Arm, context: Any = CONTEXT, **arguments: Any) -> Any:
    return anyio.run(mover(arm), MoveEndEffector(**arguments), context)


def place(arm: Arm, grip_height: GripHeight, **arguments: Any) -> Any:
    return anyio.run(Placer(mover(arm), grip_height), PlaceArguments(**arguments), CONTEXT)


def watched(arm: Arm) -> GripHeight:
    gate: Any = arm
    found = GripHeight(arm.host, gate, exposed(), gate)
    found.watch()
    return found


def test_a_move_sends_the_commanded_grip_and_says_that_the_hand_holds(arm: Arm) -> None:
    arm.close_hand()
    moved = move(arm, dz_m=0.02)
    assert set(arm.grips) == {0.0}, "not the 0.5 at which the fingers are measured"
    assert (moved.holding, moved.lost_on_the_way) == (True, False)
    assert moved.target_m == pytest.approx([0.4, 0.0, TABLE_M + 0.02])
    assert moved.moved["dz_m"] == pytest.approx(0.02, abs=0.002)


def test_what_slips_out_on_the_way_is_lost_and_what_is_let_go_is_not(arm: Arm) -> None:
    arm.close_hand()
    arm.slips_at_s = arm.now_s + 0.5
    assert move(arm, dz_m=0.2).lost_on_the_way
    arm.slips_at_s = float("inf")
    opened = move(arm, gripper_open=1.0)
    assert (opened.holding, opened.lost_on_the_way) == (False, False)


def test_a_finger_that_something_blocks_grasps(arm: Arm) -> None:
    gate: Any = arm
    limits = {"j1": LIMIT, "finger": JointLimit(lower=0, upper=0.04)}
    joint_mover = JointMover(exposed(), limits, gate, arm.host)
    moved = anyio.run(joint_mover, MoveJoints(positions={"finger": 0.0}), CONTEXT)
    assert (moved.holding, moved.error, moved.position["finger"]) == (True, 0.0, OBJECT_M)
    turned = anyio.run(joint_mover, MoveJoints(positions={"j1": 0.3}), CONTEXT)
    assert (turned.holding, turned.lost_on_the_way) == (True, False)


def test_missing_joint_states_of_a_robot_that_runs_are_not_a_robot_that_was_not_started(
    arm: Arm,
) -> None:
    gate: Any = arm
    joint_mover = JointMover(exposed(), {"j1": JointLimit(lower=-1, upper=1)}, gate, arm.host)
    arm.phase = "stopped"
    with pytest.raises(NotReadyError) as caught:
        anyio.run(joint_mover, MoveJoints(positions={"j1": 0.3}), CONTEXT)
    assert caught.value.hint == "Call start_robot first."
    arm.phase = "running"
    arm.joints = lambda exposed, timeout_s: None  # type: ignore[method-assign]
    with pytest.raises(NotReadyError, match="The robot runs, but no joint state came"):
        anyio.run(joint_mover, MoveJoints(positions={"j1": 0.3}), CONTEXT)


@pytest.mark.parametrize(("silent_s", "arrives"), [(0.3, True), (0.9, True), (30.0, False)])
def test_states_that_a_busy_server_takes_late_end_no_motion(
    arm: Arm, silent_s: float, arrives: bool
) -> None:
    gate: Any = arm
    measure = arm.newest_joints

    def late(exposed: Any) -> JointSample | None:
        return None if 0.2 < arm.now_s < 0.2 + silent_s else measure(exposed)

    arm.newest_joints = late  # type: ignore[method-assign]
    limits = {"j1": JointLimit(lower=-1, upper=1, velocity=1, acceleration=1)}
    joint_mover = JointMover(exposed(), limits, gate, arm.host)
    if arrives:
        assert anyio.run(joint_mover, MoveJoints(positions={"j1": 0.3}), CONTEXT).error < 0.01
        return
    with pytest.raises(StateError, match="not measured any more"):
        anyio.run(joint_mover, MoveJoints(positions={"j1": 0.3}), CONTEXT)
    assert arm.now_s < 2.0


def test_what_is_held_is_carried_over_others_and_put_down_at_the_height_of_the_grasp(
    arm: Arm,
) -> None:
    height = watched(arm)
    arm.close_hand()
    arm.place = arm.place + np.array([0.0, 0.0, 0.03])
    placed = place(arm, height, dx_m=0.05, dy_m=0.15)
    assert placed.released_at_m == pytest.approx([0.45, 0.15, TABLE_M + 0.002], abs=0.003)
    assert arm.highest_m >= TABLE_M + 0.08
    assert (placed.holding, arm.grips[-1]) == (False, 1.0)
    assert arm.place[2] > TABLE_M + 0.07, "the hand has left upwards"
    with pytest.raises(RefusedError, match="holds nothing"):
        place(arm, height, dy_m=0.1)


def test_a_height_that_nobody_saw_has_to_be_given(arm: Arm) -> None:
    arm.commanded = 0.0
    height = watched(arm)
    with pytest.raises(InvalidInputError, match="how high the hand was"):
        place(arm, height, dy_m=0.1)
    placed = place(arm, height, dy_m=0.1, height_m=0.2)
    assert placed.released_at_m[2] == pytest.approx(0.2, abs=0.003)


def test_what_is_lost_while_it_is_carried_ends_the_call(arm: Arm) -> None:
    height = watched(arm)
    arm.close_hand()
    arm.slips_at_s = arm.now_s + 1.0
    with pytest.raises(StateError, match="lost what it held"):
        place(arm, height, dy_m=0.4)


def test_what_is_lost_between_two_moves_ends_the_call(arm: Arm) -> None:
    height = watched(arm)
    arm.close_hand()
    arm.pause_s, arm.slips_at_s = 0.5, arm.now_s + 0.3
    with pytest.raises(StateError, match="lost what it held"):
        place(arm, height, dy_m=0.1)
    assert 1.0 not in arm.grips, "it is not let go somewhere else"


TURNING = (
    '<robot name="r"><joint name="j1" type="{}"><parent link="a"/><child link="b"/></joint></robot>'
)


@pytest.mark.parametrize(
    ("kind", "ends", "start", "goal", "points"),
    [
        ("continuous", math.inf, 3.1, -3.1, [2 * math.pi - 3.1]),
        ("continuous", math.inf, 15.0, 2.0, [2.0 + 4 * math.pi]),
        ("continuous", 3.0, 2.9, -2.9, [0.0, -2.9]),  # half a turn at a time
        ("continuous", 3.0, 1.0, -2.0, [-2.0]),
        ("revolute", 3.0, 2.9, -2.9, [-2.9]),
    ],
)
def test_a_continuous_joint_is_moved_the_shorter_way_within_its_limits(
    arm: Arm, kind: str, ends: float, start: float, goal: float, points: list[float]
) -> None:
    gate: Any = arm
    profile = replace(PROFILE, urdf=TURNING.format(kind))
    endpoint = exposed()
    endpoint.profile = profile
    limit = JointLimit(
        lower=-ends, upper=ends, velocity=1, acceleration=1, is_continuous=kind == "continuous"
    )
    joint_mover, arm.joint = JointMover(endpoint, {"j1": limit}, gate, arm.host), start
    asked = MoveJoints(positions={"j1": goal})
    joints = arm.joints(endpoint, 1.0)
    assert joints is not None
    request, duration_s = joint_mover.request(asked, joints, CONTEXT)
    (message,) = request.messages
    assert [point.positions[0] for point in message.points] == pytest.approx(points)
    last = message.points[-1].time_from_start
    assert last.sec + last.nanosec * 1e-9 == pytest.approx(duration_s)


def test_a_goal_is_reached_in_whatever_turns_it_is_measured(arm: Arm) -> None:
    gate: Any = arm
    endpoint = exposed()
    endpoint.profile = replace(PROFILE, urdf=TURNING.format("continuous"))
    limit = JointLimit(velocity=1, acceleration=1, is_continuous=True)
    joint_mover, arm.joint = JointMover(endpoint, {"j1": limit}, gate, arm.host), 3.1
    arm.wraps = True
    moved = anyio.run(joint_mover, MoveJoints(positions={"j1": -3.1}), CONTEXT)
    assert moved.position["j1"] == pytest.approx(-3.1)
    assert moved.error == pytest.approx(0.0, abs=1e-5)


@pytest.mark.parametrize("in_profile", [True, False], ids=["undriven", "none"])
class TestArmWithoutGripper:
    """Its driver drives none, or its profile has none."""

    @pytest.fixture(autouse=True)
    def _bare(self, arm: Arm, monkeypatch: pytest.MonkeyPatch, in_profile: bool) -> None:
        arm.has_hand = False
        if not in_profile:
            bare = replace(PROFILE, gripper=None)
            monkeypatch.setitem(globals(), "PROFILE", bare)

    def test_it_moves_by_deltas(self, arm: Arm) -> None:
        moved = move(arm, dz_m=0.02)
        assert moved.moved["dz_m"] == pytest.approx(0.02, abs=0.002)
        assert (moved.holding, moved.lost_on_the_way) == (None, False)

    def test_it_moves_by_joints(self, arm: Arm) -> None:
        gate: Any = arm
        mover = JointMover(exposed(), {"j1": LIMIT}, gate, arm.host)
        moved = anyio.run(mover, MoveJoints(positions={"j1": 0.2}), CONTEXT)
        assert moved.position["j1"] == pytest.approx(0.2)
        assert moved.holding is None

    @pytest.mark.parametrize("context", [CONTEXT, SimulatedContext(CONTEXT)])
    @pytest.mark.parametrize("more", [{}, {"dz_m": 0.02}])
    def test_a_move_that_names_the_gripper_is_refused(
        self, arm: Arm, more: dict[str, float], context: Any
    ) -> None:
        with pytest.raises(RefusedError) as refusal:
            move(arm, context, gripper_open=0.0, **more)
        assert refusal.value.rule == "no_gripper"
        assert arm.grips == []

    def test_nothing_can_be_placed(self, arm: Arm) -> None:
        with pytest.raises(RefusedError) as refusal:
            place(arm, watched(arm), dx_m=0.1, height_m=0.1)
        assert refusal.value.rule == "no_gripper"
        assert arm.grips == []


@pytest.mark.parametrize("context", [CONTEXT, SimulatedContext(CONTEXT)])
def test_the_joint_of_a_gripper_that_is_not_driven_cannot_be_moved(arm: Arm, context: Any) -> None:
    arm.has_hand = False
    gate: Any = arm
    mover = JointMover(exposed(), {"j1": LIMIT, "finger": LIMIT}, gate, arm.host)
    with pytest.raises(RefusedError) as refusal:
        anyio.run(mover, MoveJoints(positions={"finger": 0.0, "j1": 0.1}), context)
    assert refusal.value.rule == "no_gripper"
