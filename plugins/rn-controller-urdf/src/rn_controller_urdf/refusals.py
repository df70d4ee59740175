"""Checks of a step: pure functions that return a `Hold` with the numbers, or None."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rn_controller_urdf.ik import Solution
from rn_controller_urdf.model import ArmModel
from rn_controller_urdf.options import UrdfControllerOptions
from roboneuron import GRIPPER, Action, ControlSpace, Hold, Workspace

F64 = NDArray[np.float64]

BAD_ACTION = "bad_action"
"""The action belongs to another space than the robot's, is not finite, its gripper is not in [0,
1], or the step time is not a positive number.
"""
ACTION_TOO_LARGE = "action_too_large"
"""One action requests a longer translation or a larger rotation than the options allow."""
UNKNOWN_JOINT = "unknown_joint"
"""The measured joints lack a joint of the arm."""
BAD_STATE = "bad_state"
"""A measured joint is NaN or infinite, or names and positions differ in number."""
OUTSIDE_LIMITS = "outside_limits"
"""The arm is measured outside its joint limits by more than the slack."""
OUTSIDE_WORKSPACE = "outside_workspace"
"""The target leaves the workspace box, or lies farther outside than the present TCP."""
NO_SOLUTION = "no_solution"
"""The solver did not reach the tolerances; the reason contains the residual."""
JOINT_JUMP = "joint_jump"
"""A joint would move farther in one step than the options allow."""

HOLD_CODES = (
    BAD_ACTION,
    ACTION_TOO_LARGE,
    UNKNOWN_JOINT,
    BAD_STATE,
    OUTSIDE_LIMITS,
    OUTSIDE_WORKSPACE,
    NO_SOLUTION,
    JOINT_JUMP,
)
"""All codes of this controller."""

_SAME_DEPTH_M = 1e-6
"""Rounding tolerance when the depth outside the workspace is compared with the present one."""


@dataclass(frozen=True, kw_only=True, slots=True)
class JointBounds:
    """Bounds of one joint, in radians for revolute joints and in metres for prismatic ones.

    Plain floats: for seven joints a loop over them is faster than the calls into numpy.

    Attributes:
        name: joint name.
        unit: "rad" or "m".
        lower, upper: the joint's limits.
        slack: tolerance for a measured position outside of them.
        step: largest displacement in one step.
        velocity: the used fraction of its velocity limit, per second.
    """

    name: str
    unit: str
    lower: float
    upper: float
    slack: float
    step: float
    velocity: float


def joint_bounds(options: UrdfControllerOptions, model: ArmModel) -> tuple[JointBounds, ...]:
    """The bounds of the arm's joints, in the order of the model."""
    return tuple(
        JointBounds(
            name=name,
            unit="m" if model.prismatic[i] else "rad",
            lower=float(model.lower[i]),
            upper=float(model.upper[i]),
            slack=options.limit_slack_m if model.prismatic[i] else options.limit_slack_rad,
            step=options.max_joint_step_m if model.prismatic[i] else options.max_joint_step_rad,
            velocity=float(model.velocity[i]) * options.velocity_fraction,
        )
        for i, name in enumerate(model.joints)
    )


def check_action(action: Action, step_s: float, options: UrdfControllerOptions) -> Hold | None:
    """Check an action: BAD_ACTION or ACTION_TOO_LARGE."""
    translation, rotation = np.asarray(action.translation_m), np.asarray(action.rotation_rad)
    if translation.shape != (3,) or rotation.shape != (3,):
        return Hold(
            code=BAD_ACTION,
            reason=f"Translation and rotation have shapes {translation.shape} and "
            f"{rotation.shape}, "
            "expected (3,) and (3,).",
        )
    length, angle = math.hypot(*translation.tolist()), math.hypot(*rotation.tolist())
    if not (math.isfinite(length) and math.isfinite(angle) and 0.0 <= action.gripper_open <= 1.0):
        return Hold(
            code=BAD_ACTION,
            reason=f"The action moves {length:g} m and {angle:g} rad with gripper_open "
            f"{action.gripper_open:g}, "
            "expected finite values and an opening in [0, 1].",
        )
    return check_time(step_s) or check_reach(length, angle, options)


def check_row(space: ControlSpace, row: F64, expected: tuple[str, ...]) -> Hold | None:
    """Check a row: BAD_ACTION for a space without the `expected` channels in order, or for
    non-finite numbers.
    """
    if space.keys != expected:
        return Hold(
            code=BAD_ACTION,
            reason=f"A row of {space.kind} ({', '.join(space.keys)}) is not executed here"
            f"{f'; expected {expected}' if expected else ''}.",
        )
    values = row.tolist() if row.shape == (len(expected),) else [math.nan]
    openings = [
        value
        for key, value in zip(expected, values, strict=False)
        if key.rpartition("/")[2] == GRIPPER
    ]
    if all(map(math.isfinite, values)) and all(0.0 <= value <= 1.0 for value in openings):
        return None
    return Hold(
        code=BAD_ACTION,
        reason=f"A row of {space.kind} is {row}, expected {len(expected)} finite values"
        f"{' with the opening in [0, 1]' if openings else ''}.",
    )


def check_time(step_s: float) -> Hold | None:
    """Check a step time: BAD_ACTION."""
    if math.isfinite(step_s) and step_s > 0:
        return None
    return Hold(
        code=BAD_ACTION, reason=f"step_s is {step_s:g}, expected a finite number of seconds > 0."
    )


def check_reach(length: float, angle: float, options: UrdfControllerOptions) -> Hold | None:
    """Check a translation [m] and a rotation [rad] in one step: ACTION_TOO_LARGE."""
    if length > options.max_translation_m or angle > options.max_rotation_rad:
        return Hold(
            code=ACTION_TOO_LARGE,
            reason=f"The action moves {length:.4f} m and {angle:.4f} rad in one step, at most "
            f"{options.max_translation_m:g} m and {options.max_rotation_rad:g} rad are allowed.",
        )
    return None


def check_start(position: list[float], bounds: tuple[JointBounds, ...]) -> Hold | None:
    """Check measured arm joints [rad or m]: BAD_STATE or OUTSIDE_LIMITS."""
    for value, joint in zip(position, bounds, strict=True):
        if not joint.lower - joint.slack <= value <= joint.upper + joint.slack:
            if not math.isfinite(value):
                return Hold(code=BAD_STATE, reason=f"Joint {joint.name!r} is measured at {value}.")
            return Hold(
                code=OUTSIDE_LIMITS,
                reason=f"Joint {joint.name!r} is measured at {value:.4f} {joint.unit}, outside "
                "its limits "
                f"{joint.lower:.4f}..{joint.upper:.4f}; move it back by other means.",
            )
    return None


def check_workspace(here_m: F64, target_m: F64, workspace: Workspace | None) -> Hold | None:
    """Check a target (3,) [m, base frame]: OUTSIDE_WORKSPACE; returning from outside is allowed."""
    if (
        workspace is None
        or ((target_m >= workspace.lower_m) & (target_m <= workspace.upper_m)).all()
    ):
        return None
    wanted = np.maximum(workspace.lower_m - target_m, target_m - workspace.upper_m)
    present = np.maximum(workspace.lower_m - here_m, here_m - workspace.upper_m)
    if (wanted <= np.maximum(present, 0.0) + _SAME_DEPTH_M).all():
        return None
    return Hold(
        code=OUTSIDE_WORKSPACE,
        reason=f"The target {np.round(target_m, 4).tolist()} m is {wanted.max():.4f} m outside "
        "the workspace "
        f"{np.asarray(workspace.lower_m).tolist()}..{np.asarray(workspace.upper_m).tolist()} m.",
    )


def check_solution(solution: Solution, options: UrdfControllerOptions) -> Hold | None:
    """Check the residual against the tolerances: NO_SOLUTION."""
    off_m, off_rad = solution.residual_m, solution.residual_rad
    if off_m <= options.position_tolerance_m and (
        off_rad <= options.rotation_tolerance_rad or options.track == "position"
    ):
        return None
    return Hold(
        code=NO_SOLUTION,
        reason=f"No posture within the joint limits was found for the target: {off_m * 1e3:.3f} "
        "mm and "
        f"{off_rad * 1e3:.3f} mrad remain after {options.max_iterations} iterations, at most "
        f"{options.position_tolerance_m * 1e3:g} mm and {options.rotation_tolerance_rad * 1e3:g} "
        "mrad are allowed.",
    )


def check_step(step: list[float], bounds: tuple[JointBounds, ...]) -> Hold | None:
    """Check joint changes of either sign [rad or m]: JOINT_JUMP."""
    for change, joint in zip(step, bounds, strict=True):
        if not abs(change) <= joint.step:
            return Hold(
                code=JOINT_JUMP,
                reason=f"Joint {joint.name!r} would move {change:.3f} {joint.unit} in one step, "
                f"at most {joint.step:g} "
                f"{joint.unit} is allowed; the arm is close to a singularity or a limit. If "
                "the policy cannot leave it, move the arm away with move_joints or move_to.",
            )
    return None


def shortest_duration_s(step: list[float], bounds: tuple[JointBounds, ...]) -> float:
    """Shortest time [s] in which joint changes of either sign [rad or m] respect every joint's
    velocity limit.
    """
    return max(abs(change) / joint.velocity for change, joint in zip(step, bounds, strict=True))
