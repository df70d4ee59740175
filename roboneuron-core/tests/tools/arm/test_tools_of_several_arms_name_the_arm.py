"""move_ee, place and move_joints of a robot with two arms: one moves, the other stays where it is
and keeps what its hand holds.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import anyio
import numpy as np
import pytest
from numpy.typing import NDArray

from roboneuron.config import LimitsConfig
from roboneuron.contract import (
    EE_DELTA,
    ArmProfile,
    ControlSpace,
    Endpoint,
    GripperProfile,
    Hold,
    JointCommand,
    JointSample,
    Pose,
    Posture,
    RobotProfile,
    robot_space,
)
from roboneuron.direct_path.delivery import _hold
from roboneuron.direct_path.exposed import POSES_LABEL, action_endpoint
from roboneuron.errors import InvalidInputError, RefusedError
from roboneuron.feature import ExposedEndpoint
from roboneuron.gate.motion import MotionLimiter, motion_rules
from roboneuron.gate.motion.joint_space import JointLimit
from roboneuron.modules.report import Report
from roboneuron.server import clock
from roboneuron.server.clock import RobotClock
from roboneuron.server.motion_gate import GateRequest, TimedCommand
from roboneuron.server.verdict import Sent, Verdict
from roboneuron.tools.arm import grip, joints
from roboneuron.tools.arm.arm_rows import ArmRows, Rest
from roboneuron.tools.arm.ee_move import MoveEndEffector
from roboneuron.tools.arm.end_effector import EndEffectorMover
from roboneuron.tools.arm.joint_goals import MoveJoints
from roboneuron.tools.arm.joints import JointMover
from roboneuron.tools.arm.measured import SpeedMeter
from roboneuron.tools.arm.options import ArmToolsOptions
from roboneuron.tools.arm.prediction import ArmControl, PredictedArm
from roboneuron.tools.arm.several_arms import OfArm, of_named_arm
from roboneuron.tools.arm.tools import arm_tools

F64 = NDArray[np.float64]
SIDES = ("left", "right")
ARMS = tuple(
    ArmProfile(
        name=name,
        joints=(f"{name}_x", f"{name}_y"),
        base_link="base",
        tcp_link=f"{name}_tcp",
        gripper=GripperProfile(joint=f"{name}_finger", closed_position=0.0, open_position=0.04),
    )
    for name in SIDES
)
JOINTS = tuple(joint for arm in ARMS for joint in arm.joints)
PAIR = RobotProfile(
    name="pair",
    base_link="base",
    tcp_link="left_tcp",
    arm_joints=JOINTS,
    arms=ARMS,
    gripper=ARMS[0].gripper,
)
SPACE = robot_space("ee_pose", PAIR)
UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])
_ENDPOINT = Endpoint(
    name="joint_states", kind="read", topic="s", type="sensor_msgs/msg/JointState", summary="-"
)


def at(x: float, y: float = 0.0) -> Pose:
    return Pose(position_m=np.array([x, y, 0.3]), quaternion_xyzw=UPRIGHT)


def exposed(profile: RobotProfile = PAIR) -> ExposedEndpoint:
    given = ExposedEndpoint(
        robot="pair", namespace="pair", label="s", endpoint=_ENDPOINT, profile=profile
    )
    found = action_endpoint(given)
    assert found is not None
    return found


class Pair:
    """Time, and two arms that are where they are told to be at once."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.places = {"left": at(0.3), "right": at(0.9)}
        self.openings = {"left": 0.0, "right": 0.0}
        # around which a closed hand stops
        self.objects_m = {"left": 0.0, "right": 0.02}
        self.rows: list[F64] = []
        self.labels: set[str] = set()
        self.max_duration_s = 60.0
        self.joint_targets: dict[str, float] = {}
        self.undriven = ""

    def monotonic(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds

    def joints(self, exposed: Any, timeout_s: float = 0.0) -> JointSample:
        fingers = {
            f"{side}_finger": max(self.openings[side] * 0.04, self.objects_m[side])
            for side in SIDES
            if side != self.undriven
        }
        found = {**dict.fromkeys(JOINTS, 0.0), **self.joint_targets, **fingers}
        return JointSample(names=tuple(found), position=np.array(list(found.values())))

    newest_joints = joints

    def check_free(self, exposed: Any) -> None: ...

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
        details: object = None,
    ) -> Sent:
        sent = 0
        for command in commands:
            if command.message is not None:
                sent += 1
                self._follow(command.message)
            self.now_s = max(self.now_s + 0.01, command.due_s)
        return Sent(verdict=Verdict(allowed=True), messages=sent, subscribers=1, duration_s=1.0)

    def _follow(self, message: Any) -> None:
        if hasattr(message, "points"):
            named = dict(zip(message.joint_names, message.points[0].positions, strict=True))
            self.joint_targets |= named
            for side in SIDES:
                finger = f"{side}_finger"
                self.openings[side] = named.get(finger, self.openings[side] * 0.04) / 0.04
            return
        row = SPACE.check(message.data)
        self.rows.append(row)
        self.labels.add(message.layout.dim[0].label)
        for side, part in zip(SIDES, np.split(row, 2), strict=True):
            self.places[side] = Pose(position_m=part[:3], quaternion_xyzw=part[3:7])
            self.openings[side] = float(part[7])

    @property
    def host(self) -> Any:
        def view(kind: str) -> Any:
            told = {f"{s}/gripper_commanded": f"{self.openings[s]:g}" for s in SIDES}
            told.pop(f"{self.undriven}/gripper_commanded", None)
            detail = {f"{self.undriven}/no_gripper": "true"} if self.undriven else {}
            return SimpleNamespace(report=Report(metrics=told, detail=detail), phase="running")

        return SimpleNamespace(
            modules=SimpleNamespace(view=view, require_running=lambda kind: None),
            clock=lambda namespace: RobotClock(),
            loop=SimpleNamespace(limits=LimitsConfig()),
            config=SimpleNamespace(
                namespace="pair", robot=SimpleNamespace(name="pair"), options=lambda name: {}
            ),
            gate=self,
        )

    def tcp(self, side: str) -> Any:
        return SimpleNamespace(
            wait=lambda timeout_s, newer_than_ns=0: self.places[side], speeds=SpeedMeter()
        )


CONTEXT: Any = SimpleNamespace(who="agent", role="operator", simulated=False)


@pytest.fixture
def pair(monkeypatch: pytest.MonkeyPatch) -> Pair:
    made = Pair()

    async def run(work: Any, **more: Any) -> Any:
        return work(lambda _: None)

    CONTEXT.run = run
    for module in (grip, joints, clock):
        monkeypatch.setattr(module, "time", made)
    return made


def move(pair: Pair, **arguments: Any) -> Any:
    tcps = {side: pair.tcp(side) for side in SIDES}
    movers = {
        side: EndEffectorMover(exposed(), PAIR, pair.host, ArmToolsOptions(), tcps, side)
        for side in SIDES
    }
    return anyio.run(OfArm(movers), MoveEndEffector(**arguments), CONTEXT)


def test_the_named_arm_moves_and_the_other_is_told_to_stay(pair: Pair) -> None:
    moved = move(pair, arm="right", dx_m=-0.1)
    assert (moved.arm, moved.moved["dx_m"]) == ("right", pytest.approx(-0.1, abs=0.002))
    assert pair.labels == {SPACE.label}
    stayed = {tuple(row[:8]) for row in pair.rows}
    assert stayed == {(0.3, 0.0, 0.3, 0.0, 0.0, 0.0, 1.0, 0.0)}


def test_each_hand_keeps_what_it_was_commanded_and_not_what_it_measures(pair: Pair) -> None:
    moved = move(pair, arm="left", dy_m=0.05, gripper_open=1.0)
    assert {row[15] for row in pair.rows} == {0.0}, "not the 0.5 at which the fingers are measured"
    assert {row[7] for row in pair.rows} == {1.0}
    assert moved.holding is False
    assert move(pair, arm="right", dz_m=0.05).holding is True


@pytest.mark.parametrize(("arm", "told"), [("middle", "no arm 'middle'"), ("", "names no arm")])
def test_an_unknown_arm_is_refused_with_the_names_of_all(pair: Pair, arm: str, told: str) -> None:
    with pytest.raises(InvalidInputError, match=f"{told}; the arms are 'left', 'right'"):
        move(pair, arm=arm, dx_m=0.1)
    assert pair.rows == []


def test_an_arm_without_a_gripper_cannot_open_it(pair: Pair) -> None:
    bare = replace(PAIR, arms=(ARMS[0], replace(ARMS[1], gripper=None)))
    tcps = {side: pair.tcp(side) for side in SIDES}
    mover = EndEffectorMover(exposed(bare), bare, pair.host, ArmToolsOptions(), tcps, "right")
    with pytest.raises(RefusedError, match="'right'") as refusal:
        anyio.run(mover, MoveEndEffector(gripper_open=1.0), CONTEXT)
    assert refusal.value.rule == "no_gripper"


@pytest.mark.parametrize("side", SIDES)
def test_an_arm_whose_gripper_is_not_driven_moves_beside_one_that_grasps(
    pair: Pair, side: str
) -> None:
    other = SIDES[1 - SIDES.index(side)]
    pair.undriven = side
    assert move(pair, arm=side, dz_m=0.05).holding is None
    move(pair, arm=other, gripper_open=0.0)
    with pytest.raises(RefusedError, match=side) as refusal:
        move(pair, arm=side, gripper_open=0.0)
    assert refusal.value.rule == "no_gripper"


def test_rows_of_one_arm_stay_the_seven_values() -> None:
    one = RobotProfile(name="arm", arm_joints=("j",), gripper=ARMS[0].gripper)
    rows = ArmRows.of(one, "", {"": Rest()})
    assert rows.space is EE_DELTA
    delta = np.arange(1.0, 7.0)
    assert rows.row(at(0.0), delta, 1.7).tolist() == [*delta, 1.0]


def test_rows_of_an_arm_without_a_gripper_have_none() -> None:
    bare = replace(PAIR, arms=(ARMS[0], replace(ARMS[1], gripper=None)))
    rows = ArmRows.of(bare, "right", {side: Rest(pose=at(0.5)) for side in SIDES})
    assert rows.space.check(rows.row(at(0.5), np.zeros(6), 1.0)).shape == (15,)


def test_move_joints_says_of_each_arm_that_moved_what_its_hand_holds(pair: Pair) -> None:
    limits = {name: JointLimit(lower=-1, upper=1, velocity=1, acceleration=1) for name in JOINTS}
    gate: Any = pair
    mover = JointMover(exposed(), limits, gate, pair.host)
    positions = {"left_x": 0.1, "right_x": 0.1}
    both = anyio.run(mover, MoveJoints(positions=positions), CONTEXT)
    assert (both.hands, both.holding) == ({"left": False, "right": True}, True)
    one = anyio.run(mover, MoveJoints(positions={"left_y": 0.1}), CONTEXT)
    assert (one.hands, one.holding) == ({"left": False}, False)


def test_a_finger_of_the_second_arm_that_something_blocks_grasps(pair: Pair) -> None:
    gate: Any = pair
    pair.openings["right"] = 1.0
    mover = JointMover(
        exposed(), {"right_finger": JointLimit(lower=0, upper=0.04)}, gate, pair.host
    )
    moved = anyio.run(mover, MoveJoints(positions={"right_finger": 0.0}), CONTEXT)
    assert (moved.holding, moved.error) == (True, 0.0)


def test_a_hold_leaves_the_fingers_of_both_hands_alone() -> None:
    from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

    names = ("left_x", "left_finger", "right_finger")
    message = JointTrajectory(
        joint_names=list(names), points=[JointTrajectoryPoint(positions=[0.0] * 3)]
    )
    measured = JointSample(names=names, position=np.array([0.3, 0.02, 0.02]))
    assert _hold(message, measured, PAIR).joint_names == ["left_x"]


class Gantries:
    """Two pairs of slides; each TCP is where its slides are."""

    def load(self) -> None: ...

    def close(self) -> None: ...

    def forward(self, joints: JointSample) -> Pose:
        return self.poses(joints)[0]

    def poses(self, joints: JointSample) -> tuple[Pose, ...]:
        x, y, u, v = joints.position[:4]
        return at(x, y), at(u, v)

    def inspect(self, joints: JointSample) -> Posture:
        first, second = self.poses(joints)
        return Posture(pose=first, others=(Posture(pose=second),))

    def compute(self, action: object, joints: JointSample, step_s: float) -> JointCommand | Hold:
        return Hold(code="bad_action", reason="One arm.")

    def execute(
        self, space: ControlSpace, row: F64, joints: JointSample, step_s: float
    ) -> JointCommand | Hold:
        assert space.label == SPACE.label
        position = np.array([*row[:2], *row[8:10]])
        return JointCommand(names=JOINTS, position=position, duration_s=step_s)


def test_a_simulated_move_follows_the_rows_of_both_arms() -> None:
    gantries: Any = Gantries()
    rules = motion_rules(LimitsConfig(), PAIR)
    limiter = MotionLimiter(
        rules,
        PAIR,
        gantries.forward,
        gantries.inspect,
        poses=gantries.poses,
        longest_s=1.0,
    )
    joints = JointSample(names=JOINTS, position=np.array([0.3, 0.0, 0.9, 0.0]))
    arm = PredictedArm(ArmControl(gantries, limiter, PAIR, rules), joints)
    poses = dict(zip(SIDES, arm.poses(), strict=True))
    rows = ArmRows.of(PAIR, "right", {side: Rest(pose=pose) for side, pose in poses.items()})
    for _ in range(3):
        here = arm.poses()[1]
        arm.follow(rows.space, rows.row(here, np.array([0.01, 0, 0, 0, 0, 0.0]), 1.0), 0.1)
        assert arm.held == ""
    left, right = arm.poses()
    assert left.position_m[0] == pytest.approx(0.3)
    assert right.position_m[0] == pytest.approx(0.93, abs=1e-6)


def test_schemas_offer_the_arms_and_require_one(pair: Pair) -> None:
    def tools(profile: RobotProfile) -> dict[str, Any]:
        host = pair.host
        pair.exposed = (exposed(profile),)  # type: ignore[attr-defined]
        return {tool.name: tool for tool in arm_tools(host, ArmToolsOptions(), {}, {})}

    for name in ("move_ee", "pick", "place", "push"):
        arguments = tools(PAIR)[name].arguments
        assert arguments.properties["arm"] == {"enum": ["left", "right"]}
        assert arguments.required == ["arm"]
        one = tools(
            RobotProfile(name="arm", arm_joints=("j",), tcp_link="t", gripper=ARMS[0].gripper)
        )[name].arguments
        assert "arm" not in one.properties
        assert one.required == []


def test_several_arms_take_poses_within_any_arms_reach() -> None:
    found = exposed()
    assert (found.label, found.hidden) == (POSES_LABEL, True)
    assert found.endpoint.bounds == {"data": (-10.0, 10.0)}


def test_what_belongs_to_an_arm_is_found_by_its_name() -> None:
    assert of_named_arm({"left": 1, "right": 2}, "right") == 2
