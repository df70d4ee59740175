"""Sections of roboneuron.toml that belong to the feature: [tasks], [postures], [places] and
[events].
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from roboneuron.feature import Role

PlaceName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_-]{0,63}$")]
Finite = Annotated[float, Field(allow_inf_nan=False)]
RoleName = Annotated[str, Field(pattern=f"^({'|'.join(Role)})$")]


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class TaskMonitorOptions(_Section):
    """`[tasks.monitor]`: a monitor that watches every task beside its predicate."""

    name: str = Field(
        default="", description="installed monitor, such as cubes-success; none when empty"
    )
    options: dict[str, object] = Field(
        default_factory=dict, description="of that monitor: roboneuron plugins show"
    )
    at_least: Annotated[float, Field(gt=0.5, le=1)] = Field(
        default=0.9, description="probability from which its word counts"
    )
    period_s: Annotated[float, Field(ge=0.05, le=60)] = Field(
        default=0.2,
        description="time between two questions; a busy monitor is asked less often [s]",
    )
    wait_s: Annotated[float, Field(ge=0, le=30)] = Field(
        default=1.0,
        description="how long a task's end waits, with the arm at rest, for an unsure monitor [s]",
    )
    acts: tuple[Literal["end", "fail", "confirm"], ...] = Field(
        default=(),
        strict=False,
        description="empty: it only reports. end: its success counts where the predicate cannot "
        "judge; fail: its failure ends the task; confirm: a predicate that it does not confirm is "
        "unclear",
    )


class TaskOptions(_Section):
    """`[tasks]`: settings of run_task."""

    period_s: Annotated[float, Field(ge=0.01, le=1)] = Field(
        default=0.05, description="time between two looks at whether a task is done [s]"
    )
    max_s: Annotated[float, Field(gt=0, le=86400)] = Field(
        default=120.0,
        description="longest attempt that a caller may ask for without naming a time [s]",
    )
    max_attempts: Annotated[int, Field(ge=1, le=20)] = Field(
        default=3, description="attempts when the caller names no number"
    )
    end_wait_s: Annotated[float, Field(ge=0, le=30)] = Field(
        default=2.0,
        description="after the policy's own end, how long the world may take to show success [s]",
    )
    give_up_s: Annotated[float, Field(ge=0, le=60)] = Field(
        default=3.0,
        description="a policy that reports errors for so long without a break has given up [s]",
    )
    evidence_cameras: tuple[str, ...] = Field(
        default=(),
        strict=False,
        description="cameras that evidence images come from; the first two when empty",
    )
    approval: tuple[str, ...] = Field(
        default=(),
        strict=False,
        description='tools that a person must approve each call of: "run_task", "move_to"',
    )
    approval_roles: tuple[RoleName, ...] = Field(
        default=("operator",), strict=False, description="roles whose calls need that approval"
    )
    monitor: TaskMonitorOptions = Field(
        default=TaskMonitorOptions(), description="what watches tasks beside their predicates"
    )


class PostureOptions(_Section):
    """`[postures.<name>]`: joint positions for move_to."""

    joints: dict[str, Finite] = Field(
        min_length=1, description="position by joint [rad, m]; others stay"
    )
    summary: str = Field(default="", description="one line for agents")


class GestureOptions(_Section):
    """`[gestures.<name>]`: postures that move_to goes through, one after the other."""

    steps: Annotated[tuple[dict[str, Finite], ...], Field(strict=False)] = Field(
        min_length=1, max_length=50, description="positions by joint [rad, m]; others stay"
    )
    times: Annotated[int, Field(ge=1, le=20)] = Field(
        default=1, description="how often they are gone through"
    )
    summary: str = Field(default="", description="one line for agents")


class PlaceOptions(_Section):
    """`[places.<name>]`: a pose of the TCP in the base frame for move_to."""

    arm: str = Field(default="", description="whose TCP; needed where there are several arms")
    position_m: Annotated[tuple[Finite, Finite, Finite], Field(strict=False)] = Field(
        description="[x, y, z]"
    )
    quaternion_xyzw: Annotated[
        tuple[Finite, Finite, Finite, Finite] | None, Field(strict=False)
    ] = Field(default=None, description="orientation; the present one when not given")
    gripper_open: Annotated[float, Field(ge=0, le=1)] | None = Field(
        default=None, description="opening, 0 closed .. 1 open; kept when not given"
    )
    summary: str = Field(default="", description="one line for agents")


class ThresholdOptions(_Section):
    """`[events.thresholds.<name>]`: a field of a topic whose crossing of a value is an event."""

    topic: str = Field(min_length=1, description="under the robot's namespace, or absolute")
    type: str = Field(pattern=r"^\w+/msg/\w+$", description='such as "std_msgs/msg/Float64"')
    field: str = Field(
        min_length=1, description='path of the field, such as "pose.position.z" or "effort[7]"'
    )
    above: Finite | None = Field(
        default=None, description="it happens when the value rises above this"
    )
    below: Finite | None = Field(
        default=None, description="it happens when the value falls below this"
    )
    hysteresis: Annotated[float, Field(ge=0)] = Field(
        default=0.0, description="how far the value must come back before it can happen again"
    )


class EventOptions(_Section):
    """`[events]`: resources to which clients may subscribe."""

    kept: Annotated[int, Field(ge=1, le=10000)] = Field(
        default=100, description="events kept of each kind"
    )
    battery_topic: str = Field(
        default="battery_state",
        description="topic of sensor_msgs/BatteryState, under the robot's namespace",
    )
    battery_low: Annotated[float, Field(ge=0, le=1)] = Field(
        default=0.2,
        description="share of the charge below which the battery is low; 0: not watched",
    )
    thresholds: dict[PlaceName, ThresholdOptions] = Field(
        default_factory=dict, description="thresholds by name"
    )


class TasksSections(_Section):
    """All sections of the feature."""

    tasks: TaskOptions = Field(default=TaskOptions(), description="how run_task works")
    postures: dict[PlaceName, PostureOptions] = Field(
        default_factory=dict, description="postures by name"
    )
    places: dict[PlaceName, PlaceOptions] = Field(
        default_factory=dict, description="places by name"
    )
    gestures: dict[PlaceName, GestureOptions] = Field(
        default_factory=dict, description="gestures by name"
    )
    events: EventOptions = Field(
        default=EventOptions(), description="what clients may subscribe to"
    )
