"""Rules of robot drivers on motion: it reaches its target, takes its stated duration, and follows
the newest command. `driver_stops` has the rest.
"""

from __future__ import annotations

import math
import time
from contextlib import suppress
from dataclasses import replace

import numpy as np

from rn_testing.cases import RobotCase
from rn_testing.rule import NotApplicable, Rule, Violation, require
from rn_testing.rules.driver import (
    arm_command,
    arm_limits,
    arm_position,
    driver_rule,
    opened,
    read_state,
)
from rn_testing.waiting import holds_within
from roboneuron import F64, InvalidInputError, JointCommand, RoboNeuronError, RobotDriver

AHEAD = 0.35
"""Tolerated lead over uniform motion, as a share of the distance; smooth profiles stay below, a
jump is at 1.
"""
FAR = 20
"""Length of a watched motion in steps of the case."""
MOTION_S, LOOKS, MOST_GAPS = 0.6, 4, 3
"""Minimum duration of a motion for integrating velocities, number of tries, and minimum number of
intervals between states.
"""
SLOWEST, FASTEST = 0.1, 10.0
"""Bounds of the velocity integral divided by the distance: degrees give 57, a wrong sign a negative
value. The bounds are wide because a simulation that lags on a busy machine reports velocities of
its own time.
"""
AT_REST = 0.3
"""Tolerated velocity of an arm that stands, as a share of that of the motion before."""
OFF_ZERO = 6
"""Least distance of a joint from 0, in tolerances of the case, before others are moved."""
OPENINGS = (0.5, 0.0, 1.0)
"""Gripper openings commanded in the rules."""
OPENING_TOLERANCE = 0.15
"""Tolerance of the gripper opening."""


def shifted(case: RobotCase, start: F64, steps: float, joint: int = -1) -> F64:
    """Return `start` with one joint displaced by this many steps of the case, towards the farther
    limit.
    """
    limits = arm_limits(case)
    goal = start.copy()
    room = limits.upper[joint] - goal[joint] > goal[joint] - limits.lower[joint]
    goal[joint] += steps * (case.step if room else -case.step)
    return goal


def send_checked(case: RobotCase, driver: RobotDriver, command: JointCommand) -> JointCommand:
    """Send a command that is within all limits; it must be sent unchanged."""
    sent = driver.send(command)
    require(
        isinstance(sent, JointCommand),
        f"send returned {type(sent).__name__}, expected what was really sent",
    )
    require(sent.duration_s > 0, f"what was sent lasts {sent.duration_s} s")
    positions = dict(zip(sent.names, sent.position.tolist(), strict=True))
    for name, wanted in zip(command.names, command.position.tolist(), strict=True):
        if name not in positions:
            raise Violation(f"the command that was really sent lacks the joint {name!r}")
        off = abs(positions[name] - wanted)
        require(
            off <= case.tolerance,
            f"send of {name!r} to {wanted:.4f}, within its limits, says {positions[name]:.4f}",
        )
    return sent


def check_arrival(
    case: RobotCase, driver: RobotDriver, goal: F64, sent: JointCommand, what: str
) -> None:
    limit_s = case.settle_s + sent.duration_s
    arrived = holds_within(
        lambda: bool(np.abs(arm_position(case, driver) - goal).max() <= case.tolerance), limit_s
    )
    error = float(np.abs(arm_position(case, driver) - goal).max())
    require(arrived, f"{limit_s:g} s after {what} a joint is still {error:.4f} away")


def _check_send(case: RobotCase) -> None:
    arm_limits(case)
    with opened(case) as driver:
        goal = shifted(case, arm_position(case, driver), 1)
        sent = send_checked(case, driver, arm_command(case, goal))
        check_arrival(case, driver, goal, sent, f"a step of {case.step:g}")


def _check_by_name(case: RobotCase) -> None:
    arm_limits(case)
    with opened(case) as driver:
        goal = shifted(case, shifted(case, arm_position(case, driver), 1), 2, joint=0)
        command = arm_command(case, goal)
        turned = replace(command, names=command.names[::-1], position=command.position[::-1])
        sent = send_checked(case, driver, turned)
        check_arrival(case, driver, goal, sent, "a command with its joints in another order")


def _posture_off_zero(case: RobotCase, driver: RobotDriver) -> F64:
    """Move the arm until no joint is near 0, and return the goal: a joint that is sent to 0 from
    there moves visibly.
    """
    goal = arm_position(case, driver)
    for joint in range(len(goal)):
        if abs(goal[joint]) < OFF_ZERO * case.tolerance:
            steps = math.ceil(2 * OFF_ZERO * case.tolerance / case.step)
            goal = shifted(case, goal, steps, joint)
    limits = arm_limits(case)
    far = float((np.abs(goal - arm_position(case, driver)) / limits.velocity).max())
    sent = send_checked(case, driver, arm_command(case, goal, max(0.5, 2 * far)))
    check_arrival(case, driver, goal, sent, "a command for all joints")
    return goal


def _check_unnamed(case: RobotCase) -> None:
    arm_limits(case)
    profile = case.profile()
    with opened(case) as driver:
        posture = _posture_off_zero(case, driver)
        opening = read_state(case, driver).gripper_open
        for joint, name in ((-1, profile.arm_joints[-1]), (0, profile.arm_joints[0])):
            goal = shifted(case, posture, 1, joint)
            others = np.arange(len(goal)) != joint % len(goal)
            command = JointCommand(names=(name,), position=goal[[joint]], duration_s=0.5)
            with suppress(InvalidInputError):  # a driver may need all joints
                send_checked(case, driver, command)
            holds_within(
                lambda o=others: (
                    float(np.abs(arm_position(case, driver) - posture)[o].max())  # type: ignore[misc]
                    > case.tolerance
                ),
                2 * command.duration_s,
            )
            off = float(np.abs(arm_position(case, driver) - posture)[others].max())
            require(
                off <= case.tolerance,
                f"a command for {name!r} alone moved another joint by {off:.4f}",
            )
            driver.send(arm_command(case, posture))
            holds_within(
                lambda: bool(np.abs(arm_position(case, driver) - posture).max() <= case.tolerance),
                case.settle_s,
            )
        held = read_state(case, driver).gripper_open
    require(
        opening is None or held is None or abs(held - opening) <= OPENING_TOLERANCE,
        f"commands without the gripper moved it from {opening} to {held}; it may hold something",
    )


def _check_pace(
    case: RobotCase, driver: RobotDriver, start: F64, goal: F64, duration_s: float
) -> None:
    """Check that the motion just sent is nowhere far ahead of its duration."""
    way = float(np.abs(goal - start).max())
    begun_s = time.monotonic()
    while True:
        done = float(np.abs(arm_position(case, driver) - start).max()) / way
        passed = (time.monotonic() - begun_s) / duration_s
        if passed >= 1.0 - AHEAD:
            return
        require(
            done <= passed + AHEAD,
            f"after {passed:.0%} of {duration_s:.3g} s a joint is {done:.0%} of its way",
        )
        time.sleep(0.005)


def _check_duration(case: RobotCase) -> None:
    limits = arm_limits(case)
    # no whole number of seconds, because some robots know only these
    duration_s = max(1.8, 2 * 5 * case.step / float(limits.velocity[-1]))
    with opened(case) as driver:
        start = arm_position(case, driver)
        goal = shifted(case, start, 5)
        sent = send_checked(case, driver, arm_command(case, goal, duration_s))
        require(
            sent.duration_s >= 0.99 * duration_s,
            f"a motion of {duration_s:g} s was sent as {sent.duration_s:g} s",
        )
        _check_pace(case, driver, start, goal, sent.duration_s)
        check_arrival(case, driver, goal, sent, "a slow motion")


def _check_speed(case: RobotCase) -> None:
    limits = arm_limits(case)
    with opened(case) as driver:
        start = arm_position(case, driver)
        goal = shifted(case, start, FAR)
        needed_s = FAR * case.step / float(limits.velocity[-1])
        try:
            sent = driver.send(arm_command(case, goal, needed_s / 20))
        except RoboNeuronError:
            return
        told = (
            f"a motion that needs {needed_s:.3g} s by the velocity limit was sent as "
            f"{sent.duration_s:.3g} s"
        )
        require(sent.duration_s >= 0.95 * needed_s, told)
        _check_pace(case, driver, start, goal, sent.duration_s)
        check_arrival(case, driver, goal, sent, "a motion faster than the limits")


def _check_gripper(case: RobotCase) -> None:
    arm_limits(case)
    gripper = case.profile().gripper
    if gripper is None:
        raise NotApplicable("the robot has no gripper")
    with opened(case) as driver:
        arm = arm_command(case, arm_position(case, driver))
        for opening in OPENINGS:
            position = np.append(arm.position, gripper.to_position(opening))
            send_checked(
                case, driver, replace(arm, names=(*arm.names, gripper.joint), position=position)
            )

            def is_there(wanted: float = opening) -> bool:
                measured = read_state(case, driver).gripper_open
                return measured is not None and abs(measured - wanted) <= OPENING_TOLERANCE

            arrived = holds_within(is_there, case.settle_s)
            measured = read_state(case, driver).gripper_open
            require(arrived, f"sent to an opening of {opening:g}, the gripper is at {measured}")


def _check_newest(case: RobotCase) -> None:
    arm_limits(case)
    with opened(case) as driver:
        start = arm_position(case, driver)
        goal = shifted(case, start, -1)
        with suppress(RoboNeuronError):  # a driver may refuse the longer motion
            driver.send(arm_command(case, shifted(case, start, FAR), 30.0))
        sent = send_checked(case, driver, arm_command(case, goal))
        check_arrival(case, driver, goal, sent, "a command that replaces another")


def _velocity_samples(case: RobotCase, driver: RobotDriver, duration_s: float) -> F64:
    """Stamp [s], position and velocity (n, 3) of the last arm joint during its motion, without
    repeated stamps.
    """
    name = case.profile().arm_joints[-1]
    found: dict[int, tuple[float, float, float]] = {}

    def look() -> bool:
        joints = read_state(case, driver).joints
        index = joints.names.index(name)
        if joints.velocity is not None:
            # modulo, because a float of the full clock loses microseconds
            stamp_s = joints.stamp_ns / 1e9 % 1e6
            found[joints.stamp_ns] = (
                stamp_s,
                float(joints.position[index]),
                float(joints.velocity[index]),
            )
        return False

    holds_within(look, duration_s)
    return np.array([found[stamp] for stamp in sorted(found)]).reshape(-1, 3)


def _check_velocity_at_rest(case: RobotCase, driver: RobotDriver, most: float) -> None:
    found = [0.0]

    def is_slow() -> bool:
        velocity = read_state(case, driver).joints.velocity
        found[0] = 0.0 if velocity is None else float(np.abs(velocity).max())
        return found[0] <= most

    is_at_rest = holds_within(is_slow, case.settle_s)
    require(is_at_rest, f"after a motion the arm stands, and a velocity is still {found[0]:.4f}")


def _check_velocity(case: RobotCase) -> None:
    limits = arm_limits(case)
    with opened(case) as driver:
        if read_state(case, driver).joints.velocity is None:
            raise NotApplicable("it reports no velocities")
        duration_s = max(MOTION_S, 3 * 5 * case.step / float(limits.velocity[-1]))
        for _ in range(LOOKS):  # retried, because on a busy machine too few states may arrive
            goal = shifted(case, arm_position(case, driver), 5)
            sent = driver.send(arm_command(case, goal, duration_s))
            samples = _velocity_samples(case, driver, sent.duration_s)
            if len(samples) < MOST_GAPS:
                continue
            gaps_s = np.diff(samples[:, 0])
            way = float(samples[-1, 1] - samples[0, 1])
            if gaps_s.max() > sent.duration_s / MOST_GAPS or abs(way) < 2 * case.step:
                continue
            integral = float((gaps_s * (samples[1:, 2] + samples[:-1, 2]) / 2).sum())
            told = f"a joint moved by {way:.4f}, its velocities add up to {integral:.4f}"
            require(SLOWEST <= integral / way <= FASTEST, f"{told}; None means unknown")
            check_arrival(case, driver, goal, sent, "a motion")
            _check_velocity_at_rest(case, driver, AT_REST * abs(way) / float(gaps_s.sum()))
            return
    raise NotApplicable("too few states came during the motion to judge velocities")


RULES: tuple[Rule[RobotCase], ...] = (
    driver_rule(
        "send-arrives",
        "`send` returns what was really sent, and the robot gets there.",
        "send",
        _check_send,
    ),
    driver_rule(
        "joints-by-name",
        "Commanded joints are taken by name, in any order.",
        "send",
        _check_by_name,
    ),
    driver_rule(
        "unnamed-joints-stay",
        "A command for some joints moves no other joint, nor the gripper; or it is refused.",
        "send",
        _check_unnamed,
    ),
    driver_rule(
        "duration-kept",
        "A motion takes the duration of its command.",
        "send",
        _check_duration,
    ),
    driver_rule(
        "velocity-kept",
        "A motion too fast for the velocity limits is refused, or takes longer and `send` says so.",
        "send",
        _check_speed,
    ),
    driver_rule(
        "gripper-follows",
        "The gripper goes to the opening of its joint's position.",
        "send",
        _check_gripper,
    ),
    driver_rule(
        "newest-command-wins", "A command replaces the previous one at once.", "send", _check_newest
    ),
    driver_rule(
        "velocity-measured",
        "Velocities are those of the positions: per second, of the same sign, 0 at rest; or None.",
        "read",
        _check_velocity,
    ),
)
"""Rules of robot drivers on motion."""
