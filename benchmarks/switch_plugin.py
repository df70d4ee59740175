"""Plugin for judging change-overs: its cameras number their images, and its backends mark each
action with the image and the backend.

The first four bytes of an image hold its number. An action's `ry` returns it in nanoradians, and
its `rz` holds the backend's tag in nanoradians; the motion along x is a slow sine of the image's
time, the same for each backend. The rows of a chunk follow the sine. Rows of two chunks may be
cross-faded, but gripper values are not: they encode image, row and backend of an action (`code_of`,
`named_by`).
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

from roboneuron.plugins.hookspecs import hookimpl
from roboneuron.plugins.option_marks import AgentMaySet
from roboneuron.plugins.specs import (
    ActionSpace,
    BackendSpec,
    ControllerSpec,
    PerceptionSpec,
    RobotSpec,
)

if TYPE_CHECKING:
    from roboneuron.contract import (
        Action,
        ActionChunk,
        CameraProfile,
        Frame,
        Hold,
        JointCommand,
        JointSample,
        Observation,
        Pose,
        RobotProfile,
        Topics,
    )

PLUGIN = "switch_plugin"
NANO = 1e-9
PEAK_M = 0.002
PERIOD_S = 8.0
_ROWS, _TAGS = 64, 8


def code_of(image: int, row: int, tag: int) -> float:
    """Gripper value, at most 1, that encodes image, row and backend tag."""
    return 1.0 - ((image * _ROWS + row) * _TAGS + tag) * NANO


def named_by(gripper: float) -> tuple[int, int, int] | None:
    """Image, row and backend tag encoded in a gripper value; None when it is 1."""
    code = round((1.0 - gripper) / NANO)
    return (code // _TAGS // _ROWS, code // _TAGS % _ROWS, code % _TAGS) if code else None


def _read(path: str) -> str:
    """The current fault; empty when there is none."""
    try:
        return Path(path).read_text(encoding="ascii") if path else ""
    except FileNotFoundError:
        return ""


class CameraOptions(BaseModel):
    """Options of the numbering camera."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    rate_hz: float = Field(default=10.0, gt=0, description="images per second")
    tag: int = Field(default=0, description="number of the source, written into the images")
    scale: int = Field(default=1, ge=1, description="divisor of the camera's image size")
    mode_file: Annotated[str, AgentMaySet()] = Field(
        default="",
        description='file that names the current fault: "frozen", "black", "small", "hang"',
    )


class BackendOptions(BaseModel):
    """Options of the naming backend."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    tag: int = Field(default=1, description="number of the backend, written into the actions")
    offset_m: float = Field(default=0.0, description="added to the motion along x")
    step_s: float = Field(default=0.01, gt=0, description="period of the actions of a chunk")
    rows: int = Field(default=1, ge=1, le=_ROWS, description="actions per chunk, one per step_s")
    delay_s: float = Field(default=0.0, ge=0, description="duration of a prediction")
    hang_file: Annotated[str, AgentMaySet()] = Field(
        default="", description="a prediction waits for as long as this file exists"
    )
    mode_file: Annotated[str, AgentMaySet()] = Field(
        default="",
        description='file that names the current fault: "raise", "hang", or a delay [ms]',
    )
    fail_file: Annotated[str, AgentMaySet()] = Field(
        default="", description="a prediction fails while this file exists"
    )


class NumberingCamera:
    """Implements the protocol `PerceptionSource`; keeps its period exactly, whatever the readers
    do.
    """

    def __init__(
        self, config: CameraOptions | None, topics: Topics, cameras: tuple[CameraProfile, ...]
    ) -> None:
        self._topics, self._camera = topics, cameras[0]
        self._options = config or CameraOptions()
        self._period_s = 1.0 / self._options.rate_hz
        self._newest: Frame | None = None
        self._number = 0

    def open(self) -> None:
        """Start the image clock."""
        self._start_s = time.monotonic()

    def read(self, timeout_s: float) -> Frame:
        """The next image."""
        import numpy as np

        from roboneuron.contract import Frame

        self._number += 1
        time.sleep(max(0.0, self._start_s + self._number * self._period_s - time.monotonic()))
        mode = _read(self._options.mode_file)
        if mode == "frozen" and self._newest is not None:
            return self._newest
        while mode == "hang":
            time.sleep(0.01)
            mode = _read(self._options.mode_file)
        scale = 2 if mode == "small" else self._options.scale
        image = np.zeros(
            (self._camera.height // scale, self._camera.width // scale, 3), dtype=np.uint8
        )
        if mode != "black":
            image[0].reshape(-1)[:4] = np.frombuffer(
                self._number.to_bytes(4, "little"), dtype=np.uint8
            )
            image[0].reshape(-1)[4] = self._options.tag
        self._newest = Frame(
            camera=self._camera.name,
            image=image,
            stamp_ns=self._topics.now_ns(),
            frame_id=self._camera.frame_id,
        )
        return self._newest

    def close(self) -> None:
        """Nothing to release."""


class NamingBackend:
    """Implements the protocol `Backend`."""

    def __init__(
        self, config: BackendOptions | None, runtime: Any = None, acceleration: Any = None
    ) -> None:
        self._options = config or BackendOptions()

    def load(self) -> None:
        """Nothing to load."""

    def predict(self, observation: Observation) -> ActionChunk:
        """Points of the sine from the image's time on, marked with the image's number and the
        tag.
        """
        import numpy as np

        from roboneuron.contract import ActionChunk

        options = self._options
        while options.hang_file and Path(options.hang_file).exists():
            time.sleep(0.01)
        if options.fail_file and Path(options.fail_file).exists():
            raise ValueError("the model fell over")
        while (mode := _read(options.mode_file)) == "hang":
            time.sleep(0.01)
        if mode == "raise":
            raise ValueError("the model fell over")
        if mode:
            time.sleep(int(mode) / 1e3)
        if options.delay_s:
            time.sleep(options.delay_s)
        frame = observation.frames["primary"]
        number = int.from_bytes(frame.image[0].tobytes()[:4], "little")
        stamp_s = frame.stamp_ns / 1e9
        actions = np.zeros((options.rows, 7))
        for row in range(options.rows):
            at_s = stamp_s + row * options.step_s
            actions[row, 0] = PEAK_M * math.sin(2 * math.pi * at_s / PERIOD_S) + options.offset_m
            actions[row, 6] = code_of(number, row, options.tag)
        actions[:, 4:6] = number * NANO, options.tag * NANO
        return ActionChunk(actions=actions, step_s=options.step_s)

    def reset(self) -> None:
        """Nothing to forget."""

    def close(self) -> None:
        """Nothing to release."""


class ControllerOptions(BaseModel):
    """Options of the faulty controller."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    tool_m: float = Field(default=0.0, description="offset of its TCP along z from the gantry's")
    offset: float = Field(
        default=0.0, description="added to the commanded position of the first joint"
    )
    mode_file: Annotated[str, AgentMaySet()] = Field(
        default="", description='file that names the current fault: "hold", "raise", "hang"'
    )


class FaultyController:
    """Implements the protocol `Controller`: the gantry's controller with the faults of its
    options.
    """

    def __init__(self, config: ControllerOptions | None, profile: RobotProfile) -> None:
        from rn_testing.fakes.controller import GantryController

        self._options = config or ControllerOptions()
        self._inner = GantryController(None, profile)

    def load(self) -> None:
        """Load the gantry's controller."""
        self._inner.load()

    def forward(self, joints: JointSample) -> Pose:
        """The gantry's TCP pose, moved along z by `tool_m`."""
        from dataclasses import replace

        pose = self._inner.forward(joints)
        position_m = pose.position_m.copy()
        position_m[2] += self._options.tool_m
        return replace(pose, position_m=position_m)

    def compute(self, action: Action, joints: JointSample, step_s: float) -> JointCommand | Hold:
        """The gantry's command, with `offset` added to the first joint."""
        from dataclasses import replace

        from roboneuron.contract import Hold

        while (mode := _read(self._options.mode_file)) == "hang":
            time.sleep(0.01)
        if mode == "raise":
            raise ValueError("the controller fell over")
        if mode == "hold":
            return Hold(code="doubt", reason="The controller is in doubt.")
        command = self._inner.compute(action, joints, step_s)
        if isinstance(command, Hold):
            return command
        position = command.position.copy()
        position[0] += self._options.offset
        return replace(command, position=position)

    def close(self) -> None:
        """Close the gantry's controller."""
        self._inner.close()


@hookimpl
def roboneuron_backends() -> Sequence[BackendSpec]:
    """One policy under two names."""
    space = ActionSpace(step_s=0.01)
    return [
        BackendSpec(
            name=name,
            summary="Names the image that it acts on.",
            target=f"{PLUGIN}:NamingBackend",
            config=f"{PLUGIN}:BackendOptions",
            action_space=space,
        )
        for name in ("first", "second")
    ]


@hookimpl
def roboneuron_perceptions() -> Sequence[PerceptionSpec]:
    """One camera under two names."""
    return [
        PerceptionSpec(
            name=name,
            summary="Numbers its images.",
            target=f"{PLUGIN}:NumberingCamera",
            config=f"{PLUGIN}:CameraOptions",
        )
        for name in ("numbering", "other")
    ]


@hookimpl
def roboneuron_controllers() -> Sequence[ControllerSpec]:
    """The fake gantry's controller, and one with faults."""
    from rn_testing.fakes.controller import FAKE_CONTROLLER

    faulty = ControllerSpec(
        name="faulty",
        summary="The gantry's, with faults.",
        target=f"{PLUGIN}:FaultyController",
        config=f"{PLUGIN}:ControllerOptions",
    )
    return [FAKE_CONTROLLER, faulty]


@hookimpl
def roboneuron_robots() -> Sequence[RobotSpec]:
    """The fake gantry."""
    from rn_testing.fakes.robot import FAKE_ROBOT

    return [FAKE_ROBOT]
