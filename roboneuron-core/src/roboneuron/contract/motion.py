"""Values exchanged between controller and robot driver: measured state, joint commands, reasons to
hold.

Arrays are kept as read-only copies.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from roboneuron.contract.arrays import F64, ReadOnly
from roboneuron.contract.observation import JointSample, Pose

STATE_STEP_S = 0.1
"""Time to reach positions without a time of their own, as in a JointState."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class JointCommand(ReadOnly):
    """Joint positions to reach after `duration_s`.

    Attributes:
        names: joint names, in the order of `position`; the gripper's joint may be among them.
        position: float64 (n,), rad or m.
        duration_s: time to reach them from now [s], > 0.
        residual_m, residual_rad: remaining error of the target's position and rotation.
    """

    names: tuple[str, ...]
    position: F64
    duration_s: float
    residual_m: float = 0.0
    residual_rad: float = 0.0

    def get(self, name: str) -> float | None:
        """Position for a joint [rad or m]; None if it is not among these."""
        return float(self.position[self.names.index(name)]) if name in self.names else None


@dataclass(frozen=True, kw_only=True, slots=True)
class Hold:
    """A controller's refusal: the robot has to hold its position.

    Attributes:
        code: stable word, counted in /diagnostics ("no_solution", "joint_jump", "unknown_joint"
            ...).
        reason: one sentence with the numbers (residual, limit).
    """

    code: str
    reason: str


@dataclass(frozen=True, kw_only=True, slots=True)
class Proximity:
    """Two bodies that are closer than allowed.

    Attributes:
        first, second: names of links or obstacles.
        distance_m: between their shapes; negative if they overlap.
        least_m: the required distance.
    """

    first: str
    second: str
    distance_m: float
    least_m: float


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class LinkExtents(ReadOnly):
    """Boxes around the moving links, and around what hands may hold, along the axes of the base
    frame.

    Attributes:
        names: of the links.
        lower_m, upper_m: corners, float64 (n, 3).
    """

    names: tuple[str, ...]
    lower_m: F64
    upper_m: F64


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Posture:
    """Properties of a posture of the arm, as far as its controller can compute them.

    Attributes:
        pose: pose of the TCP in the base frame.
        smallest_singular_value: of the TCP's Jacobian in m and rad per joint unit; 0 in a
            singularity, None if unknown.
        near: every pair closer than the profile's `collision` allows, once, links of all arms
            included; None if not checked.
        extents: returns the boxes around the links of all arms; None if the controller cannot tell
            them. Called only where limits hold for the whole arm.
        others: TCP and singular value of the arms after the first, in the order of the profile's
            `arms`; () for one arm.
    """

    pose: Pose
    smallest_singular_value: float | None = None
    near: tuple[Proximity, ...] | None = None
    extents: Callable[[], LinkExtents] | None = None
    others: tuple[Posture, ...] = ()

    @property
    def arms(self) -> tuple[Posture, ...]:
        """The posture of each arm; `near` and `extents` are part of the first."""
        return (self, *self.others)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class RobotState:
    """Measurement of a driver.

    Attributes:
        joints: all joints the driver reports, the gripper's included.
        gripper_open: 0 closed .. 1 open; None without a gripper.
        detail: facts for get_status, as text (for a simulation: the positions of objects). "fault"
            is the reason for which the robot has stopped by itself; after a fault, motion has to be
            requested anew. "no_gripper" is "true" if no gripper is driven although the profile has
            one; of one of several arms "<arm>/no_gripper".
    """

    joints: JointSample
    gripper_open: float | None = None
    detail: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "detail", dict(self.detail))
