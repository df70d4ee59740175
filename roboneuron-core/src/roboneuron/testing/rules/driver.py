"""Rules of robot drivers, run on the one driver that the case allows to move."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace

import numpy as np

from roboneuron.contract import JointCommand, JointLimits, RobotDriver, RobotState
from roboneuron.contract.motion import F64
from roboneuron.errors import InvalidInputError, RoboNeuronError, StateError
from roboneuron.plugins.loading import load_options_model, load_target
from roboneuron.testing.cases import RobotCase
from roboneuron.testing.effects import expect_refusal, wait_until
from roboneuron.testing.fakes import MemoryTopics
from roboneuron.testing.lifecycle import (
    attempt,
    check_close_before_start,
    check_close_twice_and_release,
    check_protocol,
    check_pure_constructor,
    started,
)
from roboneuron.testing.rule import NotApplicable, Rule, Violation, require

READ_LIMIT_S = 0.02
"""Median time of a `read`: the contract says a millisecond; the rest is for busy machines."""
HOLD_S = 0.3
"""How long the robot is watched after `hold`."""


@contextmanager
def _open(case: RobotCase) -> Iterator[RobotDriver]:
    with started(case, lambda: case.build(MemoryTopics()), lambda driver: driver.open()) as driver:
        yield driver


def _read(case: RobotCase, driver: RobotDriver) -> RobotState:
    """The newest state, waiting for the first one when the driver has none yet."""
    found: list[RobotState] = []

    def has_state() -> bool:
        state = driver.read()
        found[:] = [state]
        return len(state.joints.names) > 0

    require(wait_until(has_state, case.settle_s), f"no joint state within {case.settle_s:g} s of open()")
    return found[0]


def _arm_position(case: RobotCase, driver: RobotDriver) -> F64:
    state = _read(case, driver)
    measured = dict(zip(state.joints.names, state.joints.position.tolist(), strict=True))
    absent = [n for n in case.profile().arm_joints if n not in measured]
    require(not absent, f"read lacks the joints {', '.join(absent)}")
    return np.array([measured[n] for n in case.profile().arm_joints])


def _limits(case: RobotCase) -> JointLimits:
    if case.spec.robot_kind != "arm":
        raise NotApplicable(f"the robot is of kind {case.spec.robot_kind!r}")
    limits = case.profile().limits
    if limits is None:
        raise Violation("an arm's profile has no limits")
    return limits


def _check_target(case: RobotCase) -> None:
    spec = case.driver_spec()
    load_options_model(spec)
    require(callable(load_target(spec)), f"`target` of driver {spec.name!r} is no class")


def _check_protocol(case: RobotCase) -> None:
    check_protocol(attempt(case, lambda: case.build(MemoryTopics())), RobotDriver)


def _check_pure(case: RobotCase) -> None:
    check_pure_constructor(case, lambda: case.build(MemoryTopics()))


def _check_close_first(case: RobotCase) -> None:
    check_close_before_start(case, lambda: case.build(MemoryTopics()))


def _check_release(case: RobotCase) -> None:
    check_close_twice_and_release(case, lambda: case.build(MemoryTopics()), lambda driver: driver.open())


def _check_state(case: RobotCase) -> None:
    profile = case.profile()
    with _open(case) as driver:
        state = _read(case, driver)
        _arm_position(case, driver)
    require(bool(np.isfinite(state.joints.position).all()), "read holds a position that is not finite")
    require(state.joints.stamp_ns > 0, f"read is stamped {state.joints.stamp_ns}, expected the measurement's time")
    if profile.gripper is not None:
        opening = state.gripper_open
        require(opening is not None and 0 <= opening <= 1, f"gripper_open is {opening}, expected 0 closed .. 1 open")


def _check_read_quick(case: RobotCase) -> None:
    with _open(case) as driver:
        _read(case, driver)
        times_s: list[float] = []
        for _ in range(21):
            before_s = time.perf_counter()
            driver.read()
            times_s.append(time.perf_counter() - before_s)
    median_s = float(np.median(times_s))
    require(median_s <= READ_LIMIT_S, f"read takes {median_s * 1000:.1f} ms, expected about 1 ms")


def _check_read_first(case: RobotCase) -> None:
    driver = attempt(case, lambda: case.build(MemoryTopics()))
    try:
        expect_refusal(driver.read, "read before open", StateError)
    finally:
        driver.close()


def _command(case: RobotCase, position: F64) -> JointCommand:
    return JointCommand(names=case.profile().arm_joints, position=position, duration_s=0.5)


def _check_send(case: RobotCase) -> None:
    limits = _limits(case)
    with _open(case) as driver:
        goal = _arm_position(case, driver)
        room = limits.upper[-1] - goal[-1] > goal[-1] - limits.lower[-1]
        goal[-1] += case.step if room else -case.step
        sent = driver.send(_command(case, goal))
        require(isinstance(sent, JointCommand), f"send returned {type(sent).__name__}, expected what was really sent")
        positions = dict(zip(sent.names, sent.position.tolist(), strict=True))
        wanted = np.array([positions[n] for n in case.profile().arm_joints])
        arrived = wait_until(
            lambda: bool(np.abs(_arm_position(case, driver) - wanted).max() <= case.tolerance), case.settle_s
        )
        error = float(np.abs(_arm_position(case, driver) - wanted).max())
    require(arrived, f"{case.settle_s:g} s after a step of {case.step:g} a joint is still {error:.4f} away")


def _check_bad_command(case: RobotCase) -> None:
    _limits(case)
    with _open(case) as driver:
        position = _arm_position(case, driver)
        good = _command(case, position)
        bad = {
            "an unknown joint": replace(good, names=("no_such_joint", *good.names[1:])),
            "a position of NaN": replace(good, position=np.full_like(position, np.nan)),
            "fewer positions than names": replace(good, position=position[1:]),
        }
        for name, command in bad.items():
            expect_refusal(lambda c=command: driver.send(c), f"send of {name}", InvalidInputError)  # type: ignore[misc]


def _check_limits(case: RobotCase) -> None:
    limits = _limits(case)
    with _open(case) as driver:
        position = _arm_position(case, driver)
        position[-1] = limits.upper[-1] + 1.0
        try:
            sent = driver.send(_command(case, position))
        except RoboNeuronError:
            return
        finally:
            driver.hold()
    positions = dict(zip(sent.names, sent.position.tolist(), strict=True))
    last = case.profile().arm_joints[-1]
    require(
        positions[last] <= limits.upper[-1] + 1e-9,
        f"{last} was sent to {positions[last]:.3f}, its upper limit is {limits.upper[-1]:g}",
    )


def _check_hold(case: RobotCase) -> None:
    limits = _limits(case)
    with _open(case) as driver:
        goal = _arm_position(case, driver)
        far = 20 * case.step
        goal[-1] += far if limits.upper[-1] - goal[-1] > far else -far
        with suppress(RoboNeuronError):  # a driver may refuse a step as large as this; then it is held where it is
            driver.send(replace(_command(case, goal), duration_s=5.0))
        driver.hold()
        wait_until(lambda: False, HOLD_S)  # braking takes a moment
        held = _arm_position(case, driver)
        wait_until(lambda: False, HOLD_S)
        moved = float(np.abs(_arm_position(case, driver) - held).max())
    require(moved <= case.tolerance, f"after hold() a joint moved on by {moved:.4f} in {HOLD_S} s")


_SOURCE = "roboneuron.contract.protocols.RobotDriver"

RULES: tuple[Rule[RobotCase], ...] = (
    Rule(
        id="driver/target-callable",
        text="The driver's `target` and `config` can be imported.",
        source="roboneuron.plugins.specs.DriverSpec",
        check=_check_target,
    ),
    Rule(id="driver/protocol", text="It has the methods of RobotDriver.", source=_SOURCE, check=_check_protocol),
    Rule(
        id="driver/constructor-pure",
        text="The constructor opens no file, starts no thread or process and computes nothing that takes time.",
        source="roboneuron.contract.protocols",
        check=_check_pure,
    ),
    Rule(
        id="driver/close-before-open",
        text="`close` may be called twice and before `open`.",
        source=f"{_SOURCE}.close",
        check=_check_close_first,
    ),
    Rule(
        id="driver/reads-state",
        text="After `open`, `read` returns finite positions of every arm joint, stamped, and the gripper's opening.",
        source=f"{_SOURCE}.read",
        check=_check_state,
    ),
    Rule(id="driver/read-quick", text="`read` does not wait.", source=f"{_SOURCE}.read", check=_check_read_quick),
    Rule(
        id="driver/read-before-open-refused",
        text="`read` before `open` is a StateError.",
        source=f"{_SOURCE}.read",
        check=_check_read_first,
    ),
    Rule(
        id="driver/send-arrives",
        text="`send` returns what was really sent, and the robot gets there.",
        source=f"{_SOURCE}.send",
        check=_check_send,
    ),
    Rule(
        id="driver/bad-command-refused",
        text="A command of unknown joints, of NaN or of unequal lengths is refused.",
        source=f"{_SOURCE}.send",
        check=_check_bad_command,
    ),
    Rule(
        id="driver/limits-kept",
        text="A position outside the limits is refused, or what is really sent is within them.",
        source=f"{_SOURCE}.send",
        check=_check_limits,
    ),
    Rule(
        id="driver/hold-stops",
        text="After `hold` the robot stands still, also when it was on its way.",
        source=f"{_SOURCE}.hold",
        check=_check_hold,
    ),
    Rule(
        id="driver/close-releases",
        text="After `open`, `close` may be called twice and leaves no thread or process behind.",
        source=f"{_SOURCE}.close",
        check=_check_release,
    ),
)
"""Rules of robot drivers."""
