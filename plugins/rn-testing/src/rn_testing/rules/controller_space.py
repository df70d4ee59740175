"""Rules of controllers on control spaces: `execute` carries out a row, or holds."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from rn_testing.cases import ControllerCase
from rn_testing.commands import (
    TRUTH_M,
    TRUTH_RAD,
    by_name,
    check_command,
    distance,
    home_sample,
    postures,
)
from rn_testing.kinematics import place_tcp
from rn_testing.rule import NotApplicable, Rule, Violation, require
from rn_testing.rules.controller import (
    RESIDUAL_M,
    RESIDUAL_RAD,
    STEP_S,
    controller_rule,
    damaged,
    loaded,
)
from rn_testing.rules.controller_bounds import MAX_STEP
from roboneuron import (
    F64,
    GRIPPER,
    Channel,
    Controller,
    ControlSpace,
    Hold,
    JointCommand,
    JointSample,
    RobotProfile,
    SpaceController,
    robot_space,
)

SMALL = 0.01
"""Displacement of each joint by a row [rad or m], feasible for every arm within `STEP_S`."""
SAME = 1e-9
FAR_M, FAR_JOINT = 5.0, 2.0
"""Distances that no arm covers in one step [m], [rad or m]."""


def _kinds(case: ControllerCase) -> list[str]:
    """Kinds of spaces for `execute`."""
    kinds = [kind for kind in case.spec.spaces if kind not in ("ee_delta", "joint_delta")]
    if not kinds:
        raise NotApplicable("it declares only ee_delta")
    return kinds


def execute(
    controller: Controller, space: ControlSpace, row: F64, joints: JointSample, step_s: float
) -> JointCommand | Hold:
    """Call `execute`; check that a refusal has a reason."""
    if not isinstance(controller, SpaceController):
        raise Violation("it declares spaces but has no `execute`")
    try:
        result = controller.execute(space, row, joints, step_s)
    except Exception as error:
        raise Violation(
            f"execute with a row of {space.kind} raised {type(error).__name__}: {error}"
        ) from error
    require(isinstance(result, (JointCommand, Hold)), f"execute returned {type(result).__name__}")
    if isinstance(result, Hold):
        require(bool(result.code and result.reason.strip()), "a Hold has no code or no reason")
    return result


def row_at(
    space: ControlSpace, profile: RobotProfile, target: JointSample, opening: float = 1.0
) -> F64:
    """Row of a pose or of positions for a posture; zero velocities."""
    pose = place_tcp(profile, by_name(target))
    numbers = {GRIPPER: opening}
    if space.kind == "ee_pose":
        numbers |= dict(zip("xyz", pose.position_m.tolist(), strict=True))
        names = (f"q{axis}" for axis in "xyzw")
        numbers |= dict(zip(names, pose.quaternion_xyzw.tolist(), strict=True))
    elif space.kind == "joint_position":
        numbers |= by_name(target)
    else:
        numbers |= dict.fromkeys(profile.arm_joints, 0.0)
    return np.array([numbers[key] for key in space.keys])


def _spaces(case: ControllerCase) -> Iterator[ControlSpace]:
    """The robot's own spaces, at the rate of `STEP_S`."""
    for kind in _kinds(case):
        yield robot_space(kind, case.robot(), 1.0 / STEP_S)


def _moved(profile: RobotProfile, joints: JointSample, by: F64) -> JointSample:
    position = joints.position.copy()
    for name, change in zip(profile.arm_joints, by.tolist(), strict=True):
        position[joints.names.index(name)] += change
    return replace(joints, position=position)


def _mixed(joints: JointSample) -> JointSample:
    """The same sample in another order, with an additional joint."""
    names = (*reversed(joints.names), "another_joint")
    return JointSample(
        names=names, position=np.append(joints.position[::-1], 9.0), stamp_ns=joints.stamp_ns
    )


def _check_executed(case: ControllerCase) -> None:
    profile = case.robot()
    by = np.where(np.arange(len(profile.arm_joints)) % 2, SMALL, -SMALL)
    with loaded(case) as controller:
        for space in _spaces(case):
            for joints in postures(profile):
                target = _moved(profile, joints, by)
                for opening in (0.0, 0.3, 1.0):
                    row = row_at(space, profile, target, opening)
                    sent = execute(controller, space, row, _mixed(joints), STEP_S)
                    if isinstance(sent, Hold):
                        raise Violation(f"a small row of {space.kind} was refused: {sent.reason}")
                    check_command(sent, joints, profile, STEP_S)
                    end = target if space.kind != "joint_velocity" else joints
                    _check_end(space, sent, end, joints, profile)
                    _check_opening(sent, profile, opening)


def _check_end(
    space: ControlSpace,
    sent: JointCommand,
    target: JointSample,
    joints: JointSample,
    profile: RobotProfile,
) -> None:
    reached = {**by_name(joints), **by_name(sent)}
    if space.kind == "ee_pose":
        place, wanted = place_tcp(profile, reached), place_tcp(profile, by_name(target))
        off_m, off_rad = distance(place, wanted)
        require(
            off_m <= sent.residual_m + TRUTH_M and off_rad <= sent.residual_rad + TRUTH_RAD,
            f"a row of ee_pose ends {off_m:.4f} m and {off_rad:.4f} rad from its pose, the "
            f"command says {sent.residual_m:.4f} m and {sent.residual_rad:.4f} rad",
        )
        far = sent.residual_m > RESIDUAL_M or sent.residual_rad > RESIDUAL_RAD
        require(not far, f"a small row of ee_pose leaves {sent.residual_m:g} m")
        return
    for name in profile.arm_joints:
        off = abs(reached[name] - by_name(target)[name])
        require(off <= SAME, f"a row of {space.kind} sends {name} {off:g} away from its target")


def _check_opening(sent: JointCommand, profile: RobotProfile, opening: float) -> None:
    if profile.gripper is None:
        return
    at, wanted = by_name(sent).get(profile.gripper.joint), profile.gripper.to_position(opening)
    span = abs(profile.gripper.open_position - profile.gripper.closed_position)
    require(
        at is not None and abs(at - wanted) <= 0.01 * span,
        f"an opening of {opening:g} sends {profile.gripper.joint!r} to {at}, expected {wanted:g}",
    )


def _check_velocities(case: ControllerCase) -> None:
    if "joint_velocity" not in _kinds(case):
        raise NotApplicable("it does not execute joint velocities")
    profile = case.robot()
    joints = home_sample(profile)
    measured = by_name(joints)
    with loaded(case) as controller:
        for step_s in (0.05, 0.2):
            space = robot_space("joint_velocity", profile, 1.0 / step_s)
            for moving in profile.arm_joints:
                for speed in (0.05, -0.1):
                    row = row_at(space, profile, joints)
                    row[space.keys.index(moving)] = speed
                    sent = execute(controller, space, row, joints, step_s)
                    if isinstance(sent, Hold):
                        raise Violation(f"{speed:g} of {moving} per second is held: {sent.reason}")
                    at = by_name(sent)
                    for name in profile.arm_joints:
                        wanted = measured[name] + (speed * step_s if name == moving else 0.0)
                        require(
                            abs(at.get(name, np.inf) - wanted) <= SAME,
                            f"{speed:g} of {moving} per second, for {step_s:g} s, sends {name} to "
                            f"{at.get(name)}, expected {wanted:g}",
                        )


def _check_foreign(case: ControllerCase) -> None:
    profile = case.robot()
    joints = home_sample(profile)
    with loaded(case) as controller:
        for space in _spaces(case):
            own = space.channels
            others = {
                "a channel that the robot does not have": (
                    replace(own[0], name="another_joint"),
                    *own[1:],
                ),
                "one channel too many": (*own, Channel(name="another_joint", unit="rad")),
                "one channel too few": own[1:],
                "channels of another arm": tuple(replace(one, arm="left") for one in own),
            }
            for what, channels in others.items():
                odd = replace(space, channels=channels)
                row = np.zeros(odd.size)
                for part in odd.quaternions:
                    row[part] = [0.0, 0.0, 0.0, 1.0]
                answer = execute(controller, odd, row, joints, STEP_S)
                require(
                    isinstance(answer, Hold),
                    f"a row of {space.kind} with {what} led to {type(answer).__name__}, "
                    "expected Hold",
                )


def _check_deltas(case: ControllerCase) -> None:
    _kinds(case)
    profile = case.robot()
    joints = home_sample(profile)
    space = robot_space("joint_delta", profile, 1.0 / STEP_S)
    with loaded(case) as controller:
        answer = execute(controller, space, np.zeros(space.size), joints, STEP_S)
    require(
        isinstance(answer, Hold),
        "a row of joint_delta, which never reaches a controller, was not held",
    )


def _check_bad_rows(case: ControllerCase) -> None:
    profile = case.robot()
    joints = home_sample(profile)
    with loaded(case) as controller:
        for space in _spaces(case):
            good = row_at(space, profile, joints)
            bad = [(name, good, sample, STEP_S) for name, sample in damaged(joints).items()]
            for place, key in enumerate(space.keys):
                for number in (np.nan, np.inf, -np.inf):
                    row = good.copy()
                    row[place] = number
                    bad.append((f"{key} of {number}", row, joints, STEP_S))
            bad += [
                (f"step_s {step_s:g}", good, joints, step_s) for step_s in (0.0, -0.1, float("nan"))
            ]
            for what, row, sample, step_s in bad:
                answer = execute(controller, space, row, sample, step_s)
                require(
                    isinstance(answer, Hold),
                    f"a row of {space.kind} with {what} led to {type(answer).__name__}, "
                    "expected Hold",
                )


def _check_jumps(case: ControllerCase) -> None:
    profile = case.robot()
    joints = home_sample(profile)
    with loaded(case) as controller:
        for space in _spaces(case):
            count = 3 if space.kind == "ee_pose" else len(profile.arm_joints)
            far = FAR_M if space.kind == "ee_pose" else FAR_JOINT
            if space.kind == "joint_velocity":
                far /= STEP_S
            for place in range(count):
                for sign in (1.0, -1.0):
                    row = row_at(space, profile, joints)
                    row[place] += sign * far
                    answer = execute(controller, space, row, joints, STEP_S)
                    if isinstance(answer, Hold):
                        continue
                    at, measured = by_name(answer), by_name(joints)
                    step = max(abs(at[n] - measured[n]) for n in profile.arm_joints if n in at)
                    require(
                        step <= MAX_STEP,
                        f"a row of {space.kind} moves a joint by {step:.2f} in {STEP_S:g} s",
                    )


_SOURCE = "roboneuron.contract.protocols.SpaceController.execute"
RULES: tuple[Rule[ControllerCase], ...] = (
    controller_rule(
        "spaces-executed",
        "A small row of each declared space is executed: it ends where it says, by the URDF, with "
        "measured joints in any order.",
        _check_executed,
        _SOURCE,
    ),
    controller_rule(
        "velocities-integrate",
        "A row of joint velocities moves each joint by its velocity times `step_s`, of the same "
        "sign, and no other one.",
        _check_velocities,
        _SOURCE,
    ),
    controller_rule(
        "foreign-rows-hold",
        "`execute` holds for rows whose channels are not the robot's own.",
        _check_foreign,
        _SOURCE,
    ),
    controller_rule(
        "deltas-hold",
        "`execute` holds for joint_delta, which inference resolves.",
        _check_deltas,
        _SOURCE,
    ),
    controller_rule(
        "bad-rows-hold",
        "`execute` holds with a reason, and never raises, for missing or non-finite numbers "
        "and invalid times.",
        _check_bad_rows,
        _SOURCE,
    ),
    controller_rule(
        "row-jumps-harmless",
        "A row that is far from the arm is refused, or moves no joint by over 0.3 rad.",
        _check_jumps,
        _SOURCE,
    ),
)
"""Rules of controllers on control spaces."""
