"""The plugin of the fault benchmarks: robot, camera, controller and backends that misbehave on
request by a file.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from pydantic import BaseModel, ConfigDict, Field

from roboneuron.plugins.hookspecs import hookimpl
from roboneuron.plugins.option_marks import AgentMaySet
from roboneuron.plugins.specs import (
    ActionSpace,
    BackendSpec,
    ControllerSpec,
    DriverSpec,
    PerceptionSpec,
    RobotSpec,
)

if TYPE_CHECKING:
    from roboneuron.contract import RobotProfile

PARTS = "fault_parts"


def read_mode(path: str) -> str:
    """The current fault; empty for none."""
    try:
        return Path(path).read_text(encoding="ascii") if path else ""
    except FileNotFoundError:
        return ""


class FaultOptions(BaseModel):
    """Options of the gantry and of its controller, in one table of plugin options."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    mode_file: Annotated[str, AgentMaySet()] = Field(
        default="",
        description='what is wrong: "stale", "future", "frozen", "reordered", "missing-joint", '
        '"unknown-names", "nan", '
        '"stamps+<s>", "robot-clock+<s>", "control-clock+<s>"',
    )


def profile() -> RobotProfile:
    """Profile of the fake gantry; an agent may also send its trajectories directly."""
    from rn_testing.fakes.robot import gantry_profile
    from roboneuron.contract import Endpoint

    gantry = gantry_profile()
    trajectory = Endpoint(
        name="arm",
        kind="publish",
        topic="joint_trajectory",
        type="trajectory_msgs/msg/JointTrajectory",
        summary="Where the joints go.",
        joint_limited=True,
    )
    return replace(gantry, endpoints=(*gantry.endpoints, trajectory))


@hookimpl
def roboneuron_backends() -> Sequence[BackendSpec]:
    """Two policies, each under two names: one without feedback, and one that swings about a
    position.
    """
    first = BackendSpec(
        name="first",
        summary="Names the image that it acts on, and fails on demand.",
        target=f"{PARTS}:HungryBackend",
        config=f"{PARTS}:HungryBackendOptions",
        action_space=ActionSpace(step_s=0.01),
    )
    steady = replace(
        first,
        name="steady",
        target=f"{PARTS}:SteadyBackend",
        config=f"{PARTS}:SteadyBackendOptions",
        needs_state=True,
    )
    return [first, replace(first, name="second"), steady, replace(steady, name="steadier")]


@hookimpl
def roboneuron_perceptions() -> Sequence[PerceptionSpec]:
    """The camera."""
    return [
        PerceptionSpec(
            name="numbering",
            summary="Numbers its images, by a clock that may be wrong.",
            target=f"{PARTS}:LyingCamera",
            config=f"{PARTS}:LargeCameraOptions",
        )
    ]


@hookimpl
def roboneuron_controllers() -> Sequence[ControllerSpec]:
    """The controller of the fake gantry."""
    return [
        ControllerSpec(
            name="gantry",
            summary="Reads the joints off the target pose, by a clock that may be wrong.",
            target=f"{PARTS}:JumpingController",
            config="fault_plugin:FaultOptions",
        )
    ]


@hookimpl
def roboneuron_robots() -> Sequence[RobotSpec]:
    """The fake gantry."""
    from rn_testing.fakes.robot import FAKE_ROBOT

    driver = DriverSpec(
        name="simulated",
        summary="Reaches every command at once, and may lie about it.",
        target=f"{PARTS}:LyingDriver",
        config="fault_plugin:FaultOptions",
    )
    return [replace(FAKE_ROBOT, target="fault_plugin:profile", drivers=(driver,))]
