"""docs/action-spaces.md: its example works, and its spaces have the given units. What does not fit
is refused.
"""

from __future__ import annotations

import re
import runpy
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rn_controller_urdf.controller import UrdfController
from rn_controller_urdf.plugin import roboneuron_controllers
from rn_robot_fr3.profile import profile
from roboneuron.config import LimitsConfig
from roboneuron.contract import (
    EE_DELTA,
    SPACE_KINDS,
    ActionChunk,
    Channel,
    ControlSpace,
    JointCommand,
    JointSample,
    RobotProfile,
    robot_space,
)
from roboneuron.errors import PlanningError, RoboNeuronError
from roboneuron.gate.motion import MotionLimiter, motion_rules
from roboneuron.modules.control.module import ControlModule, _executed_spaces
from roboneuron.modules.inference.agreement import SpaceAgreement, agree

PAGE = (Path(__file__).parents[1] / "docs" / "action-spaces.md").read_text(encoding="utf-8")
ROBOT = profile()
(CONTROLLER,) = roboneuron_controllers()


def example() -> dict[str, Any]:
    """Names defined by the page's code."""
    (code,) = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)
    names: dict[str, Any] = {}
    exec(compile(code, "action-spaces.md", "exec"), names)
    return names


def declared(**options: object) -> ControlSpace:
    declare: Callable[[Mapping[str, object], object], ControlSpace] = example()["declare"]
    return declare(options, ROBOT)


def agreed(space: ControlSpace, kinds: tuple[str, ...] = SPACE_KINDS) -> SpaceAgreement:
    return agree(space, ROBOT, kinds, backend="glide", controller="urdf", longest_s=0.3)


def convert(space: ControlSpace, made: ControlSpace, rate_hz: float = 15.0) -> ActionChunk:
    row = np.zeros((1, made.size))
    return agreed(space).convert(ActionChunk(actions=row, step_s=1 / rate_hz, space=made), None)


def label(text: str) -> None:
    control = ControlModule.__new__(ControlModule)
    control.spaces = _executed_spaces(CONTROLLER, UrdfController(None, ROBOT), ROBOT)
    control._agreed_space(text)


def first_channel(**changes: str) -> ControlSpace:
    space = declared()
    return replace(space, channels=(replace(space.channels[0], **changes), *space.channels[1:]))


FAULTS: dict[str, Callable[[], object]] = {
    "other channels": lambda: agreed(declared(joints=(*ROBOT.arm_joints[:6], "hip"))),
    "other unit or frame": lambda: agreed(first_channel(unit="deg/s")),
    "controller cannot execute it": lambda: agreed(declared(), ("ee_delta",)),
    "velocities without a rate": lambda: agreed(replace(declared(), rate_hz=0.0)),
    "period longer than control waits": lambda: agreed(replace(declared(), rate_hz=2.0)),
    "chunk in another space": lambda: convert(declared(), EE_DELTA),
    "chunk with another period": lambda: convert(declared(), declared(), 5.0),
    "deltas without measured joints": lambda: convert(
        robot_space("joint_delta", ROBOT), robot_space("joint_delta", ROBOT)
    ),
    "unknown label": lambda: label("torque:fr3_joint1"),
    "not a number": lambda: declared().check([np.nan] * 8),
    "opening outside 0 .. 1": lambda: declared().check([0.0] * 7 + [1.2]),
    "no quaternion": lambda: robot_space("ee_pose", ROBOT).check([0.0] * 8),
}


def test_the_example_moves_an_fr3() -> None:
    backend = example()["BACKEND"]
    assert backend.space.endswith(":declare")
    space = agreed(declared(), CONTROLLER.spaces).executed
    label(space.label)
    shown = space.label.replace(",".join(ROBOT.arm_joints[1:6]), "...")
    assert f"`{shown}`" in PAGE


def test_the_page_names_every_space_with_its_units() -> None:
    rows = dict(re.findall(r"^\| `(\w+)` \| .* \| (.*) \|$", PAGE, flags=re.MULTILINE))
    assert tuple(rows) == SPACE_KINDS
    for kind, units in rows.items():
        channels: tuple[Channel, ...] = robot_space(kind, ROBOT).channels
        found = {channel.unit for channel in channels} - {"opening"}
        assert found <= set(units.split(", "))


MESSAGES = {
    "other channels": "the backend lacks fr3_joint7; the robot lacks hip",
    "other unit or frame": "unit of fr3_joint1: 'deg/s', expected 'rad/s'",
    "controller cannot execute it": "executes ee_delta",
    "velocities without a rate": "the backend does not say how many rows a second it yields",
    "period longer than control waits": "2 rows a second are too few",
    "chunk in another space": "The backend answered in ee_delta",
    "chunk with another period": "answered with 5 rows a second; it declares 15",
    "deltas without measured joints": "The measured joints lack fr3_joint1",
    "unknown label": "An action is labelled 'torque:fr3_joint1'; this control executes",
    "not a number": "non-finite value at fr3_joint1",
    "opening outside 0 .. 1": "gripper_open is 1.2",
    "no quaternion": "have the length 0, expected 1",
}
"""Part of the message, by fault."""


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_refused_by_its_name(fault: str) -> None:
    with pytest.raises(RoboNeuronError) as refusal:
        FAULTS[fault]()
    assert MESSAGES[fault] in refusal.value.message


def rover() -> RobotProfile:
    """The robot of examples/rover_profile.py."""
    names = runpy.run_path(str(Path(__file__).parents[1] / "examples" / "rover_profile.py"))
    made: RobotProfile = names["rover"]()
    return made


def test_the_base_of_the_rover_is_channels_like_its_arm() -> None:
    space = robot_space("joint_velocity", rover(), 10.0)
    units = {channel.name: channel.unit for channel in space.channels}
    assert units == {
        **dict.fromkeys(("base_x", "base_y", "lift"), "m/s"),
        **dict.fromkeys(("base_yaw", "shoulder"), "rad/s"),
        "gripper_open": "opening",
    }
    policy = replace(space, channels=space.channels[::-1])  # in any order
    agreement = agree(
        policy, rover(), CONTROLLER.spaces, backend="drive", controller="urdf", longest_s=0.3
    )
    row = np.array([[0.25, 0.0, 0.0, 0.5, 0.0, 0.3]])
    chunk = agreement.convert(ActionChunk(actions=row, step_s=0.1, space=policy), None)
    assert chunk.actions.tolist() == [[0.3, 0.0, 0.5, 0.0, 0.0, 0.25]]
    for twist in ("m/s", "rad"):
        wrong = replace(space.channels[2], unit=twist)
        channels = (*space.channels[:2], wrong, *space.channels[3:])
        with pytest.raises(PlanningError, match="unit of base_yaw"):
            agree(
                replace(space, channels=channels),
                rover(),
                CONTROLLER.spaces,
                backend="drive",
                controller="urdf",
            )


@pytest.mark.parametrize("wanted", [0.3, 0.9])
def test_the_limits_hold_for_the_base_of_the_rover(wanted: float) -> None:
    facts = rover()
    controller = UrdfController(None, facts)
    controller.load()
    rules = motion_rules(LimitsConfig(max_speed_m_s=2.0, max_step_m=0.2), facts)
    limiter = MotionLimiter(rules, facts, controller.forward, controller.inspect)
    space = robot_space("joint_velocity", facts, 10.0)
    names, position = (*facts.arm_joints, "finger"), np.array([*facts.home_rad, 0.02])
    velocities, durations, now_s = [], [], 100.0
    for _ in range(15):
        joints = JointSample(names=names, position=position)
        row = np.array([wanted, 0.0, 0.5, 0.0, 0.0, 1.0])
        command = controller.execute(space, row, limiter.reference(joints, now_s), 0.1)
        assert isinstance(command, JointCommand)
        sent = limiter.limit(command, joints, now_s).command
        assert isinstance(sent, JointCommand)
        ends = dict(zip(sent.names, sent.position.tolist(), strict=True))
        moved = np.array([ends[name] for name in names]) - position
        velocities.append(moved[0] / sent.duration_s)
        durations.append(sent.duration_s)
        position, now_s = position + moved, now_s + sent.duration_s
        assert ends["finger"] == pytest.approx(0.05)
    assert (np.diff([0.0, *velocities]) <= 0.8 * 1.001 * np.array(durations)).all()
    assert min(wanted, 0.5) <= max(velocities) + 1e-9
    assert max(velocities) <= 0.6
    assert position[2] > 0.3, "it turned meanwhile"
