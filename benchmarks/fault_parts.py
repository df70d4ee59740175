"""Parts of a robot cell that fail on demand: the fault of each is read from a file at run time.

The gantry's driver reports wrong joints, while `true_joint_states` contains the true ones; the
clocks of cameras and processes jump; the backend consumes memory.
"""

from __future__ import annotations

import math
import time
from dataclasses import replace
from typing import Any

import numpy as np
from fault_plugin import FaultOptions, read_mode
from pydantic import Field
from sensor_msgs.msg import JointState
from switch_plugin import PERIOD_S, BackendOptions, CameraOptions, NamingBackend, NumberingCamera

from rn_testing.fakes.controller import GantryController
from rn_testing.fakes.robot import FakeDriver
from roboneuron.contract import (
    ActionChunk,
    CameraProfile,
    Frame,
    JointSample,
    Observation,
    Pose,
    RobotProfile,
    RobotState,
    Topics,
)
from roboneuron.ros.messages import to_joint_state

_BEHIND_NS = 100_000_000
_true_time_ns = time.time_ns


class LargeCameraOptions(CameraOptions):
    """Options of the numbering camera with a clock of its own."""

    width: int = Field(default=0, ge=0, description="image width [px]; the profile's when 0")
    height: int = Field(default=0, ge=0, description="image height [px]; the profile's when 0")
    clock_file: str = Field(
        default="", description="a file that says how far its clock is ahead [s]"
    )


class HungryBackendOptions(BackendOptions):
    """Options of the naming backend that can consume memory."""

    memory_file: str = Field(
        default="", description="each prediction keeps 40 MB while this file holds a word"
    )


class LyingCamera(NumberingCamera):
    """Implements the protocol `PerceptionSource`; its stamps may be wrong."""

    def __init__(
        self, config: LargeCameraOptions | None, topics: Topics, cameras: tuple[CameraProfile, ...]
    ) -> None:
        self._more = config or LargeCameraOptions()
        camera = cameras[0]
        width, height = self._more.width or camera.width, self._more.height or camera.height
        super().__init__(self._more, topics, (replace(camera, width=width, height=height),))

    def read(self, timeout_s: float) -> Frame:
        """The next image, stamped by the camera's own clock."""
        frame = super().read(timeout_s)
        ahead_s = float(read_mode(self._more.clock_file) or 0.0)
        return replace(frame, stamp_ns=frame.stamp_ns + int(ahead_s * 1e9))


class HungryBackend(NamingBackend):
    """Implements the protocol `Backend`; it may leak memory."""

    def __init__(
        self, config: HungryBackendOptions | None, runtime: Any = None, acceleration: Any = None
    ) -> None:
        super().__init__(config, runtime, acceleration)
        self._memory_file = config.memory_file if config is not None else ""
        self._kept: list[Any] = []

    def predict(self, observation: Observation) -> ActionChunk:
        """As the naming backend, but may leak memory."""
        if read_mode(self._memory_file):
            self._kept.append(np.ones(5_000_000))
        return super().predict(observation)


class SteadyBackendOptions(HungryBackendOptions):
    """Options of the backend that swings about a position."""

    centre_m: float = Field(default=0.1, description="x of the TCP about which it swings")


class SteadyBackend(HungryBackend):
    """Implements the protocol `Backend`: swings by 60 mm in 8 s with feedback, so that it never
    drifts.
    """

    def __init__(
        self, config: SteadyBackendOptions | None, runtime: Any = None, acceleration: Any = None
    ) -> None:
        super().__init__(config, runtime, acceleration)
        self._centre_m = (config or SteadyBackendOptions()).centre_m

    def predict(self, observation: Observation) -> ActionChunk:
        """Steps of at most 3 mm towards the position of the swing: the whole distance for a single
        row, a tenth of it for rows of a chunk.

        The first rows of a chunk are too old on arrival, so each row must contribute.
        """
        chunk = super().predict(observation)
        assert observation.ee_pose is not None
        stamp_s = observation.frames["primary"].stamp_ns / 1e9
        actions = chunk.actions.copy()
        at_s = stamp_s + np.arange(len(actions) + 1) * chunk.step_s
        targets_m = self._centre_m + 0.06 * np.sin(2 * math.pi * at_s / PERIOD_S)
        away_m = targets_m[0] - observation.ee_pose.position_m[0]
        steps_m = away_m if len(actions) == 1 else np.diff(targets_m) + 0.1 * away_m
        actions[:, 0] = np.clip(steps_m, -0.003, 0.003)
        return replace(chunk, actions=actions)


def set_clock(mode: str, process: str) -> None:
    """Set this process's wall clock, as seen by Python, if `mode` names `process`, and restore it
    otherwise.
    """
    word = f"{process}-clock"
    if mode.startswith(word):
        shift_ns = int(float(mode.removeprefix(word)) * 1e9)
        time.time_ns = lambda: _true_time_ns() + shift_ns
    else:
        time.time_ns = _true_time_ns


class LyingDriver(FakeDriver):
    """Implements the protocol `RobotDriver`; the results of `read` may be wrong."""

    def __init__(self, config: FaultOptions | None, profile: RobotProfile, topics: Topics) -> None:
        super().__init__(None, profile, topics)
        self._mode_file = (config or FaultOptions()).mode_file
        self._publish = topics.advertise("true_joint_states", JointState)
        self._told: JointSample | None = None
        self._turn = 0

    def read(self) -> RobotState:
        """The last sent positions, or wrong ones."""
        state = super().read()
        self._publish(to_joint_state(state.joints))
        mode = read_mode(self._mode_file)
        set_clock(mode, "robot")
        told = self._distort(state.joints, mode)
        if mode != "frozen":
            self._told = told
        return replace(state, joints=told)

    def _distort(self, joints: JointSample, mode: str) -> JointSample:
        if mode == "stale":
            return replace(joints, stamp_ns=joints.stamp_ns - 1_000_000_000)
        if mode == "future":
            return replace(joints, stamp_ns=joints.stamp_ns + 3_600_000_000_000)
        if mode == "frozen":
            return self._told or joints
        if mode == "reordered":
            self._turn += 1
            behind = _BEHIND_NS if self._turn % 2 else 0
            return replace(
                joints,
                stamp_ns=joints.stamp_ns - behind,
                position=joints.position - (0.05 if behind else 0),
            )
        if mode == "missing-joint":
            return replace(
                joints, names=joints.names[1:], position=joints.position[1:], velocity=None
            )
        if mode == "unknown-names":
            return replace(joints, names=tuple(f"other_{name}" for name in joints.names))
        if mode == "nan":
            return replace(joints, position=np.full(len(joints.names), np.nan))
        if mode.startswith("stamps"):
            return replace(
                joints, stamp_ns=joints.stamp_ns + int(float(mode.removeprefix("stamps")) * 1e9)
            )
        return joints


class JumpingController(GantryController):
    """Implements the protocol `Controller`; its process's clock may be wrong."""

    def __init__(self, config: FaultOptions | None, profile: RobotProfile) -> None:
        super().__init__(None, profile)
        self._mode_file = (config or FaultOptions()).mode_file

    def forward(self, joints: JointSample) -> Pose:
        """As the gantry's; it is called for every joint state, and so sets the clock even without
        actions.
        """
        set_clock(read_mode(self._mode_file), "control")
        return super().forward(joints)
