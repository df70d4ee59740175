"""Rules of robot drivers on standing still: after hold, after open, and before the next motion."""

from __future__ import annotations

import threading
from contextlib import suppress

import numpy as np

from rn_testing.attempts import attempt
from rn_testing.cases import RobotCase
from rn_testing.fakes import MemoryTopics
from rn_testing.lifecycle import started
from rn_testing.rule import NotApplicable, Rule, Violation, require
from rn_testing.rules.clock import ros_clock
from rn_testing.rules.driver import (
    arm_command,
    arm_limits,
    arm_position,
    driver_rule,
    opened,
    read_state,
)
from rn_testing.rules.driver_motion import (
    FAR,
    OPENING_TOLERANCE,
    check_arrival,
    send_checked,
    shifted,
)
from rn_testing.waiting import holds_within
from roboneuron import F64, JointCommand, RoboNeuronError, RobotDriver

HOLD_S = 0.3
"""Time for which the robot is watched after `hold` [s]."""
CREEP = 0.1
"""Tolerated steady motion of a held joint in one direction, as a share of the case's tolerance."""
_WATCH_S = 0.01
"""Period of the looks at a driver while it is closed."""
STARTS, STALE_S = 5, 0.3
"""Number of motions of which the quickest start counts, and its maximum delay [s]; a busy machine
delays single ones, not all.
"""


def _half_open(case: RobotCase, driver: RobotDriver) -> None:
    """Bring the gripper to half of its opening: from there both directions are visible."""
    gripper = case.profile().gripper
    if gripper is None:
        return
    position = np.array([gripper.to_position(0.5)])
    with suppress(RoboNeuronError):  # a driver may need all joints
        driver.send(JointCommand(names=(gripper.joint,), position=position, duration_s=0.5))
        holds_within(
            lambda: abs((read_state(case, driver).gripper_open or 0.0) - 0.5) <= OPENING_TOLERANCE,
            case.settle_s,
        )


def _check_hold(case: RobotCase) -> None:
    limits = arm_limits(case)
    with opened(case) as driver:
        _half_open(case, driver)
        start = arm_position(case, driver)
        goal = shifted(case, start, FAR)
        duration_s = max(5.0, 4 * FAR * case.step / float(limits.velocity[-1]))
        # a driver may refuse such a large step; it is then held at its position
        with suppress(RoboNeuronError):
            driver.send(arm_command(case, goal, duration_s))
            # displaced from the start position
            holds_within(lambda: _moved(case, driver, start) >= case.step, case.settle_s)
        before, opening = arm_position(case, driver), read_state(case, driver).gripper_open
        driver.hold()
        holds_within(lambda: False, HOLD_S)  # time for braking
        held = [arm_position(case, driver)]
        for _ in range(3):
            holds_within(lambda: False, HOLD_S / 2)
            held.append(arm_position(case, driver))
        held_opening = read_state(case, driver).gripper_open
        _check_second_hold(case, driver)
    if opening is not None and held_opening is not None:
        kept = abs(held_opening - opening) <= OPENING_TOLERANCE
        require(
            kept,
            f"hold() moved the gripper from {opening:.2f} to {held_opening:.2f}; it may hold "
            "something",
        )
    moved = float(np.abs(held[-1] - held[0]).max())
    jumped = float(np.abs(held[0] - before).max())
    require(
        moved <= case.tolerance,
        f"after hold() a joint moved on by {moved:.4f} in {1.5 * HOLD_S:g} s",
    )
    allowed = 0.25 * FAR * case.step + case.tolerance
    require(jumped <= allowed, f"hold() moved a joint by {jumped:.4f}")
    steps = np.diff(np.array(held), axis=0)
    one_way = (np.abs(np.sign(steps).sum(axis=0)) == 3) & (
        np.abs(steps[-1]) >= 0.5 * np.abs(steps[0])
    )
    # settling decelerates, and noise changes its direction
    creeps = float((np.abs(steps.sum(axis=0)) * one_way).max())
    require(
        creeps <= CREEP * case.tolerance,
        f"after hold() a joint creeps on, {creeps:.5f} in {1.5 * HOLD_S:g} s",
    )


def _check_second_hold(case: RobotCase, driver: RobotDriver) -> None:
    """Several parts of the system may hold, one after the other."""
    before = arm_position(case, driver)
    driver.hold()
    holds_within(lambda: False, HOLD_S)
    moved = _moved(case, driver, before)
    require(moved <= case.tolerance, f"a second hold() moved a joint by {moved:.4f}")


def _moved(case: RobotCase, driver: RobotDriver, start: F64) -> float:
    return float(np.abs(arm_position(case, driver) - start).max())


def _check_open_still(case: RobotCase) -> None:
    arm_limits(case)
    with opened(case) as driver:
        start = arm_position(case, driver)
        holds_within(lambda: False, HOLD_S)
        moved = _moved(case, driver, start)
        require(
            moved <= case.tolerance,
            f"without any command a joint moved after open() by {moved:.4f}",
        )
        with suppress(RoboNeuronError):  # it may refuse the step, or to be opened again
            driver.send(arm_command(case, shifted(case, start, FAR), 10.0))
            holds_within(lambda: _moved(case, driver, start) >= case.step, case.settle_s)
            driver.close()
            driver.open()
            again = arm_position(case, driver)
            holds_within(lambda: False, HOLD_S)
            moved = _moved(case, driver, again)
            require(
                moved <= case.tolerance,
                f"a motion that close() ended goes on by {moved:.4f} after open()",
            )


def _stands(case: RobotCase, driver: RobotDriver) -> bool:
    before = arm_position(case, driver)
    holds_within(lambda: False, 0.05)
    return _moved(case, driver, before) < 0.05 * case.step


def _check_fresh(case: RobotCase) -> None:
    arm_limits(case)
    delays_s: list[float] = []
    with opened(case) as driver:
        for _ in range(STARTS):
            holds_within(lambda: _stands(case, driver), case.settle_s)
            start = arm_position(case, driver)
            goal = shifted(case, start, 2)
            begun_ns = ros_clock()
            sent = driver.send(arm_command(case, goal, 0.2))
            holds_within(lambda s=start: _moved(case, driver, s) > 0.2 * case.step, case.settle_s)  # type: ignore[misc]
            late_s = (
                read_state(case, driver).joints.stamp_ns - begun_ns
            ) / 1e9 - 0.5 * sent.duration_s
            delays_s.append(late_s)
            if late_s <= STALE_S:
                return
            holds_within(lambda g=goal: _moved(case, driver, g) <= case.tolerance, case.settle_s)  # type: ignore[misc]
    told = f"by the stamps of the states each motion begins {min(delays_s):.2f} s late or later"
    raise Violation(f"{told}; a state is stamped when it was measured")


def _check_after_hold(case: RobotCase) -> None:
    arm_limits(case)
    with opened(case) as driver:
        driver.hold()
        goal = shifted(case, arm_position(case, driver), 1)
        sent = send_checked(case, driver, arm_command(case, goal))
        check_arrival(case, driver, goal, sent, "a command after hold()")


def _check_close_still(case: RobotCase) -> None:
    arm_limits(case)
    build = attempt(case, lambda: case.prepare(MemoryTopics(ros_clock)))
    sent: list[JointCommand] = []

    def watched() -> RobotDriver:
        driver: RobotDriver = build()
        send = driver.send

        def noted(command: JointCommand) -> JointCommand:
            sent.append(command)
            return send(command)

        try:
            driver.send = noted  # type: ignore[method-assign]
        except AttributeError:
            raise NotApplicable("methods of the driver cannot be replaced") from None
        return driver

    with started(case, watched, lambda driver: driver.open()) as driver:
        start = arm_position(case, driver)
        with suppress(RoboNeuronError):  # it may refuse the step; away from where it began
            driver.send(arm_command(case, shifted(case, start, 1), 0.5))
            holds_within(
                lambda: _moved(case, driver, start) >= 0.5 * case.step and _stands(case, driver),
                case.settle_s,
            )
        sent.clear()
        moved = _moved_by_close(case, driver)
    require(
        not sent,
        f"close() sent {len(sent)} commands; what surrounds the arm then is not known",
    )
    require(
        moved <= case.tolerance,
        f"close() moved a joint by {moved:.4f} before it ended; what surrounds the arm then is "
        "not known",
    )


def _moved_by_close(case: RobotCase, driver: RobotDriver) -> float:
    """Close the driver; return the largest motion of a joint that it told meanwhile."""
    start = arm_position(case, driver)
    moved, ended = [0.0], threading.Event()

    def watch() -> None:
        while not ended.wait(_WATCH_S):
            try:
                moved.append(_moved(case, driver, start))
            except Exception:  # closed
                return

    watcher = threading.Thread(target=watch, name="close-watch", daemon=True)
    watcher.start()
    try:
        driver.close()
    finally:
        ended.set()
        watcher.join(case.settle_s + 1.0)
    return max(moved)


RULES: tuple[Rule[RobotCase], ...] = (
    driver_rule(
        "hold-stops",
        "After `hold` arm and gripper stand still, also during a motion and after another `hold`.",
        "hold",
        _check_hold,
    ),
    driver_rule(
        "open-stands-still",
        "`open` moves nothing, also after a `close` that ended a motion.",
        "open",
        _check_open_still,
    ),
    driver_rule("close-stands-still", "`close` moves nothing.", "close", _check_close_still),
    driver_rule(
        "state-fresh",
        "A state is stamped when it was measured, not when it is read.",
        "read",
        _check_fresh,
    ),
    driver_rule(
        "moves-after-hold", "After `hold` the next command is followed.", "hold", _check_after_hold
    ),
)
"""Rules of robot drivers on standing still."""
