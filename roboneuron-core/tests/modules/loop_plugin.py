"""A robot with two joints, a camera and controllers, as one plugin for tests of the modules; its
backends are in loop_backends.py.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from roboneuron.contract import (
    Action,
    CameraProfile,
    ControlSpace,
    Frame,
    Hold,
    JointCommand,
    JointLimits,
    JointSample,
    Pose,
    RobotProfile,
    RobotState,
    Topics,
)
from roboneuron.contract.arrays import F64
from roboneuron.errors import NotReadyError
from roboneuron.modules.inference.module import InferenceModule
from roboneuron.modules.predictions import AnsweredPrediction
from roboneuron.modules.step_filters import StepFilter
from roboneuron.plugins.hookspecs import hookimpl
from roboneuron.plugins.specs import (
    ActionSpace,
    BackendSpec,
    CameraSpec,
    ControllerSpec,
    DriverSpec,
    PerceptionSpec,
    Requirement,
    RobotSpec,
    RuntimeSpec,
)

JOINTS = ("a", "b")
SPACE = ActionSpace(step_s=0.02)


@hookimpl
def roboneuron_backends() -> Sequence[BackendSpec]:
    names = {
        "instant": "Instant",
        "broken": "Broken",
        "picky": "Picky",
        "slow": "Slow",
        "nan": "NaN",
        "chunked": "Chunked",
        "moody": "Moody",
    }
    return [
        BackendSpec(
            name=name,
            summary="x",
            target=f"loop_backends:{cls}",
            action_space=SPACE,
            needs_state=name == "picky",
        )
        for name, cls in names.items()
    ] + [
        BackendSpec(
            name="fickle",
            summary="x",
            target="loop_backends:Fickle",
            action_space=SPACE,
            space="loop_backends:declared",
        ),
        BackendSpec(
            name="planner",
            summary="x",
            target="loop_backends:Planner",
            action_space=SPACE,
            space="loop_backends:positions",
        ),
        BackendSpec(
            name="served",
            summary="x",
            target="loop_backends:Served",
            action_space=SPACE,
            family="pair",
            runtimes_required=True,
            default_runtime="patient",
        ),
    ]


@hookimpl
def roboneuron_runtimes() -> Sequence[RuntimeSpec]:
    return [
        RuntimeSpec(name="patient", summary="x", target="loop_backends:Patient", families=("pair",))
    ]


@hookimpl
def roboneuron_perceptions() -> Sequence[PerceptionSpec]:
    return [
        PerceptionSpec(name="noise", summary="x", target="loop_plugin:Noise"),
        PerceptionSpec(name="silent", summary="x", target="loop_plugin:Silent"),
    ]


@hookimpl
def roboneuron_controllers() -> Sequence[ControllerSpec]:
    return [
        ControllerSpec(name="adder", summary="x", target="loop_plugin:Adder"),
        ControllerSpec(name="slider", summary="x", target="loop_plugin:Slider"),
        ControllerSpec(
            name="follower",
            summary="x",
            target="loop_plugin:Follower",
            spaces=("ee_delta", "ee_pose", "joint_position", "joint_velocity"),
        ),
        ControllerSpec(
            name="mover",
            summary="x",
            target="loop_plugin:Mover",
            spaces=("ee_delta", "joint_velocity", "joint_delta"),
        ),
        ControllerSpec(
            name="glider", summary="x", target="loop_plugin:Mover", spaces=("joint_velocity",)
        ),
        ControllerSpec(
            name="boaster", summary="x", target="loop_plugin:Adder", spaces=("joint_position",)
        ),
        ControllerSpec(
            name="wheels", summary="x", target="loop_plugin:Adder", robot_kinds=("base",)
        ),
    ]


@hookimpl
def roboneuron_robots() -> Sequence[RobotSpec]:
    driver = DriverSpec(name="simulated", summary="x", target="loop_plugin:Driver")
    elsewhere = DriverSpec(
        name="elsewhere",
        summary="x",
        target="loop_plugin:Driver",
        requires=(Requirement(module="no_such_module_here", install="nothing provides it"),),
    )
    camera = CameraSpec(name="front", role="primary")
    return [
        RobotSpec(
            name="pair",
            summary="x",
            target="loop_plugin:profile",
            drivers=(driver, elsewhere),
            cameras=(camera,),
        ),
        RobotSpec(name="loose", summary="x", target="loop_plugin:loose_profile", drivers=(driver,)),
        RobotSpec(
            name="slider", summary="x", target="loop_plugin:slider_profile", drivers=(driver,)
        ),
    ]


def loose_profile() -> RobotProfile:
    """The robot "pair" with limits that no test of timing reaches."""
    far = np.full(2, 1e6)
    limits = JointLimits(lower=-far, upper=far, velocity=far, acceleration=far, effort=far)
    return replace(profile(), limits=limits, cameras=())


def slider_profile() -> RobotProfile:
    """The robot "loose" with a TCP, whose x is the first joint's position by "slider"."""
    return replace(loose_profile(), tcp_link="tip")


def profile() -> RobotProfile:
    one = np.ones(2)
    return RobotProfile(
        name="pair",
        base_link="base",
        arm_joints=JOINTS,
        limits=JointLimits(lower=-one, upper=one, velocity=one, acceleration=one, effort=one),
        home_rad=np.zeros(2),
        cameras=(
            CameraProfile(name="front", role="primary", frame_id="optical", width=8, height=6),
        ),
    )


class Windows(StepFilter):
    """Handover windows of a feature that replaces modules."""

    phase = StepFilter.StepPhase.HANDOVER

    def __init__(self, shadow: bool, status: Any) -> None:
        self.status = status
        self.moments = {
            "act_from_ns": 2**62 if shadow else 0,
            "act_until_ns": 0,
            "play_until_ns": 0,
        }
        self.withheld: list[Any] = []
        self.sent: list[str] = []
        self.inference: InferenceModule | None = None

    def set(self, name: str, moment_ns: int) -> None:
        self.moments[name] = moment_ns

    def sends(self, stamp_ns: int) -> bool:
        return stamp_ns >= self.moments["act_from_ns"]

    def admits(self, stamp_ns: int) -> bool:
        is_over = 0 < self.moments["act_until_ns"] <= stamp_ns
        if is_over and self.inference is not None:
            self.status.set(note="handed over to the successor")
        return not is_over

    def ends_rows(self, now_ns: int) -> bool:
        return 0 < self.moments["play_until_ns"] <= now_ns

    def withhold(self, output: Any) -> None:
        self.withheld.append(output)

    def note_sent(self, what: str) -> None:
        self.sent.append(what)

    def come_between(self, module: Any) -> None:
        """Decide for an inference module, like such a feature."""
        if isinstance(module, InferenceModule):
            self.inference = module

    def deliver(
        self, answer: AnsweredPrediction, proceed: Callable[[AnsweredPrediction], None]
    ) -> None:
        if self.inference is None or self.sends(answer.prediction.captured_ns):
            proceed(answer)
            return
        self.status.set(note="in shadow")
        self.withhold(answer.chunk)
        self.inference.note_first(answer.prediction.observation.stamp_ns)


def join(host: Any) -> None:
    windows = Windows(host.settings.is_successor, host.status)
    host.filters.append(windows)
    host.on_configured.append(windows.come_between)
    for name, moment_ns in windows.moments.items():
        host.add_parameter(
            name, moment_ns, partial(windows.set, name), lambda ns: "no ROS time" if ns < 0 else ""
        )


class Noise:
    def __init__(self, config: None, topics: Topics, cameras: tuple[CameraProfile, ...]) -> None:
        self.topics = topics

    def open(self) -> None: ...

    def read(self, timeout_s: float) -> Frame:
        time.sleep(0.02)
        image = np.zeros((6, 8, 3), dtype=np.uint8)
        return Frame(camera="front", image=image, stamp_ns=self.topics.now_ns(), frame_id="optical")

    def close(self) -> None: ...


class Silent(Noise):
    def read(self, timeout_s: float) -> Frame:
        time.sleep(timeout_s)
        raise NotReadyError("The camera does not deliver.", hint="Is it plugged in?")


class Adder:
    """Adds the x translation to the first joint; refuses more than 0.1 m."""

    def __init__(self, config: None, profile: RobotProfile) -> None: ...

    def load(self) -> None: ...

    def forward(self, joints: JointSample) -> Pose:
        return Pose(
            position_m=np.zeros(3),
            quaternion_xyzw=np.array([0, 0, 0, 1.0]),
            stamp_ns=joints.stamp_ns,
        )

    def compute(self, action: Action, joints: JointSample, step_s: float) -> JointCommand | Hold:
        if action.translation_m[0] > 0.1:
            return Hold(code="too_far", reason=f"{action.translation_m[0]} m is more than 0.1 m.")
        position = joints.position + np.array([action.translation_m[0], 0.0])
        return JointCommand(names=JOINTS, position=position, duration_s=step_s)

    def close(self) -> None: ...


class Slider(Adder):
    """Takes the first joint's position for the x of the TCP."""

    def forward(self, joints: JointSample) -> Pose:
        x = float(joints.position[joints.names.index("a")])
        return replace(super().forward(joints), position_m=np.array([x, 0.0, 0.0]))


class Follower(Adder):
    """Also executes rows of other spaces; a pose is x for the first joint and y for the other."""

    def execute(
        self, space: ControlSpace, row: np.ndarray, joints: JointSample, step_s: float
    ) -> JointCommand | Hold:
        position = row[:2]
        if space.kind == "joint_velocity":
            position = joints.position + row[:2] * step_s
        return JointCommand(names=JOINTS, position=position, duration_s=step_s)


class Mover(Adder):
    """Also executes joint velocities, and records the requests."""

    def __init__(self, config: None, profile: RobotProfile) -> None:
        self.executed: list[tuple[ControlSpace, list[float], JointSample, float]] = []

    def execute(
        self, space: ControlSpace, row: F64, joints: JointSample, step_s: float
    ) -> JointCommand | Hold:
        self.executed.append((space, row.tolist(), joints, step_s))
        position = joints.position + row * step_s
        return JointCommand(names=JOINTS, position=position, duration_s=step_s)


class Driver:
    """Reaches every target at once and records its commands."""

    def __init__(self, config: None, profile: RobotProfile, topics: Topics) -> None:
        self.topics = topics
        self.position = np.zeros(2)
        self.sent: list[JointCommand] = []
        self.holds = 0

    def open(self) -> None: ...

    def read(self) -> RobotState:
        joints = JointSample(names=JOINTS, position=self.position, stamp_ns=self.topics.now_ns())
        return RobotState(joints=joints, gripper_open=0.5, detail={"mood": "fine"})

    def send(self, command: JointCommand) -> JointCommand:
        self.position = command.position
        self.sent.append(command)
        return command

    def hold(self) -> None:
        self.holds += 1

    def close(self) -> None: ...
