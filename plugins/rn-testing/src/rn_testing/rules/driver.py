"""Rules of robot drivers: reliable state, and refusal of invalid commands. `driver_motion` has the
rest.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace

import numpy as np

from rn_testing.attempts import attempt
from rn_testing.cases import RobotCase
from rn_testing.effects import check_quick, expect_refusal
from rn_testing.fakes import MemoryTopics
from rn_testing.lifecycle import Lifecycle, started
from rn_testing.rule import NotApplicable, Rule, Violation, require
from rn_testing.rules.clock import FUTURE_S, PAST_S, ros_clock
from rn_testing.snapshots import snapshot
from rn_testing.waiting import holds_within
from roboneuron import (
    F64,
    InvalidInputError,
    JointCommand,
    JointLimits,
    NotReadyError,
    RoboNeuronError,
    RobotDriver,
    RobotState,
)
from roboneuron.feature import loading

READ_LIMIT_S = 0.02
"""Limit of the median duration of a `read`: the contract says 1 ms; the rest is for busy
machines.
"""
SEND_LIMIT_S = 0.2
"""Limit of the quickest of some `send` calls, which must not wait for the end of the motion."""
STAMP_S = 1.0
"""Maximum time without a new stamp [s]."""
HOLD_LIMIT_S = 0.3
"""Limit of the quickest of some `hold` calls: a stop must not wait for it."""
LOOKS = 11
"""Number of stamps checked."""
OUTSIDE = 0.05
"""Tolerance of measured joints outside the limits [rad or m]."""


@contextmanager
def opened(case: RobotCase) -> Iterator[RobotDriver]:
    """Open the case's driver, with the kit's ROS time."""
    build = attempt(case, lambda: case.prepare(MemoryTopics(ros_clock)))
    with started(case, build, lambda driver: driver.open()) as driver:
        yield driver


def read_state(case: RobotCase, driver: RobotDriver) -> RobotState:
    """The newest state; waits for one if necessary, also while the driver says that it has none,
    as a busy machine makes it.
    """
    found: list[RobotState] = []
    end_s = time.monotonic() + case.settle_s

    def has_state() -> bool:
        try:
            state = driver.read()
        except NotReadyError:
            if time.monotonic() > end_s:
                raise
            return False
        require(
            isinstance(state, RobotState),
            f"read returned {type(state).__name__}, expected a RobotState",
        )
        found[:] = [state]
        return len(state.joints.names) > 0

    require(
        holds_within(has_state, case.settle_s),
        f"no joint state within {case.settle_s:g} s of open()",
    )
    return found[0]


def arm_position(case: RobotCase, driver: RobotDriver) -> F64:
    """Measured arm joints (n,) in the order of the profile."""
    state = read_state(case, driver)
    measured = dict(zip(state.joints.names, state.joints.position.tolist(), strict=True))
    absent = [n for n in case.profile().arm_joints if n not in measured]
    require(not absent, f"read lacks the joints {', '.join(absent)}")
    return np.array([measured[n] for n in case.profile().arm_joints])


def arm_limits(case: RobotCase) -> JointLimits:
    """Limits of the arm. Raises NotApplicable for other robots."""
    if case.spec.robot_kind != "arm":
        raise NotApplicable(f"the robot is of kind {case.spec.robot_kind!r}")
    limits = case.profile().limits
    if limits is None:
        raise Violation("an arm's profile has no limits")
    return limits


def arm_command(case: RobotCase, position: F64, duration_s: float = 0.5) -> JointCommand:
    """Command for all arm joints, in the order of the profile."""
    return JointCommand(names=case.profile().arm_joints, position=position, duration_s=duration_s)


def _send_home(case: RobotCase, driver: RobotDriver) -> object:
    arm_limits(case)
    home = case.profile().home_rad
    if home is None:
        raise NotApplicable("the profile has no home posture")
    return driver.send(arm_command(case, home))


def _send_nonsense(case: RobotCase, driver: RobotDriver) -> object:
    return driver.send(JointCommand(names=("no_such_joint",), position=np.zeros(1), duration_s=0.5))


def _open(case: RobotCase, driver: RobotDriver) -> None:
    driver.open()


LIFECYCLE: Lifecycle[RobotCase, RobotDriver] = Lifecycle(
    subject="driver",
    protocol=RobotDriver,
    begin="open",
    start=_open,
    uses={
        "read": lambda case, driver: driver.read(),
        "send": _send_home,
        "hold": lambda case, driver: driver.hold(),
    },
    abuses=(_send_nonsense,),
)
"""Start and use of a driver."""


def _check_target(case: RobotCase) -> None:
    spec = case.driver_spec()
    loading.load_options_model(spec)
    require(callable(loading.load_target(spec)), f"`target` of driver {spec.name!r} is no class")


def _check_topics_untouched(case: RobotCase) -> None:
    topics = MemoryTopics()
    attempt(case, lambda: case.build(topics))
    require(
        not topics.used,
        f"the constructor uses the topics {', '.join(topics.used)}; use them in open()",
    )


def _check_state(case: RobotCase) -> None:
    profile = case.profile()
    with opened(case) as driver:
        state = read_state(case, driver)
        arm = arm_position(case, driver)
    joints = state.joints
    require(len(set(joints.names)) == len(joints.names), "read names a joint twice")
    require(
        joints.position.shape == (len(joints.names),),
        f"read has {joints.position.shape} positions for its names",
    )
    require(bool(np.isfinite(joints.position).all()), "read holds a position that is not finite")
    if joints.velocity is not None:
        require(
            joints.velocity.shape == joints.position.shape,
            "read has not one velocity for each position",
        )
        require(
            bool(np.isfinite(joints.velocity).all()),
            "read holds a velocity that is not finite; None means unknown",
        )
    limits = profile.limits
    if limits is not None:
        outside = (arm < limits.lower - OUTSIDE) | (arm > limits.upper + OUTSIDE)
        astray = [n for n, out in zip(profile.arm_joints, outside.tolist(), strict=True) if out]
        require(
            not astray, f"read is outside of the limits for {', '.join(astray)}; are those degrees?"
        )
    if profile.gripper is not None:
        opening = state.gripper_open
        require(
            opening is not None and 0 <= opening <= 1,
            f"gripper_open is {opening}, expected 0 closed .. 1 open",
        )


def _check_state_kept(case: RobotCase) -> None:
    arm_limits(case)
    with opened(case) as driver:
        first = read_state(case, driver)
        before = snapshot(first)
        goal = arm_position(case, driver)
        goal[-1] += case.step if goal[-1] < arm_limits(case).upper[-1] - case.step else -case.step
        driver.send(arm_command(case, goal))
        holds_within(
            lambda: bool(np.abs(arm_position(case, driver) - goal).max() <= case.tolerance),
            case.settle_s,
        )
    require(snapshot(first) == before, "a state changes when the next one is read")


def _check_stamps(case: RobotCase) -> None:
    with opened(case) as driver:
        opened_ns = ros_clock()
        first_ns = newest_ns = read_state(case, driver).joints.stamp_ns
        until_s, looks = time.monotonic() + STAMP_S, 0
        while looks < LOOKS or (time.monotonic() < until_s and newest_ns - first_ns < 50_000_000):
            looks += 1
            stamp_ns = read_state(case, driver).joints.stamp_ns
            early_s, late_s = (opened_ns - stamp_ns) / 1e9, (stamp_ns - ros_clock()) / 1e9
            require(
                late_s <= FUTURE_S, f"a state is stamped {late_s:.3g} s in the future of ROS time"
            )
            require(
                early_s <= PAST_S,
                f"a state is stamped {early_s:.3g} s before open() in ROS time, in nanoseconds",
            )
            require(
                stamp_ns >= newest_ns,
                f"a state is stamped {(newest_ns - stamp_ns) / 1e9:.3g} s before the last one",
            )
            newest_ns = stamp_ns
            time.sleep(0.005)
    require(newest_ns > first_ns, f"the stamp stays the same for {STAMP_S:g} s")


def _check_read_quick(case: RobotCase) -> None:
    with opened(case) as driver:
        read_state(case, driver)
        _check_reads(driver, "")
        with suppress(NotApplicable, RoboNeuronError):  # a driver may refuse such a large step
            limits = arm_limits(case)
            goal = np.clip(arm_position(case, driver) + 20 * case.step, limits.lower, limits.upper)
            driver.send(arm_command(case, goal, 5.0))
            _check_reads(driver, " during a motion")


def _check_reads(driver: RobotDriver, when: str) -> None:
    times_s: list[float] = []
    for _ in range(21):
        before_s = time.perf_counter()
        driver.read()
        times_s.append(time.perf_counter() - before_s)
    median_ms = 1000 * float(np.median(times_s))
    told = f"read takes {median_ms:.1f} ms{when}, expected about 1 ms"
    require(median_ms <= 1000 * READ_LIMIT_S, told)


def _check_send_quick(case: RobotCase) -> None:
    arm_limits(case)
    with opened(case) as driver:
        command = replace(arm_command(case, arm_position(case, driver)), duration_s=2.0)
        check_quick(SEND_LIMIT_S, lambda: driver.send(command), "send")


def _check_hold_quick(case: RobotCase) -> None:
    with opened(case) as driver:
        read_state(case, driver)
        check_quick(HOLD_LIMIT_S, driver.hold, "hold")


def _check_bad_command(case: RobotCase) -> None:
    arm_limits(case)
    with opened(case) as driver:
        position = arm_position(case, driver)
        good = arm_command(case, position + case.step)
        bad = {
            "an unknown joint": replace(good, names=("no_such_joint", *good.names[1:])),
            "two positions for one joint": replace(good, names=(good.names[1], *good.names[1:])),
            "a position of NaN": replace(good, position=np.full_like(position, np.nan)),
            "an infinite position": replace(good, position=np.append(good.position[:-1], np.inf)),
            "fewer positions than names": replace(good, position=position[1:]),
            "a duration of 0": replace(good, duration_s=0.0),
            "a negative duration": replace(good, duration_s=-1.0),
            "a duration of NaN": replace(good, duration_s=float("nan")),
        }
        for name, command in bad.items():
            expect_refusal(lambda c=command: driver.send(c), f"send of {name}", InvalidInputError)  # type: ignore[misc]
        holds_within(lambda: False, 0.2)
        moved = float(np.abs(arm_position(case, driver) - position).max())
    require(moved <= case.tolerance, f"after refused commands a joint has moved by {moved:.4f}")


def _check_limits(case: RobotCase) -> None:
    limits, names = arm_limits(case), case.profile().arm_joints
    with opened(case) as driver:
        start = arm_position(case, driver)
        for joint, name in enumerate(names):
            for bound, beyond in ((limits.lower[joint], -1.0), (limits.upper[joint], 1.0)):
                if not np.isfinite(bound):  # it turns without end
                    continue
                position = start.copy()
                position[joint] = bound + beyond
                try:
                    sent = driver.send(arm_command(case, position))
                except RoboNeuronError:
                    continue
                finally:
                    driver.hold()
                reached = dict(zip(sent.names, sent.position.tolist(), strict=True))[name]
                inside = limits.lower[joint] - 1e-9 <= reached <= limits.upper[joint] + 1e-9
                require(inside, f"{name} was sent to {reached:.3f}, its limit is {bound:g}")
        _check_gripper_limits(case, driver)


def _check_gripper_limits(case: RobotCase, driver: RobotDriver) -> None:
    for gripper in case.profile().grippers:
        ends = sorted((gripper.closed_position, gripper.open_position))
        travel = ends[1] - ends[0]
        for beyond in (ends[0] - travel, ends[1] + travel):
            command = JointCommand(
                names=(gripper.joint,), position=np.array([beyond]), duration_s=0.5
            )
            try:
                sent = driver.send(command)
            except RoboNeuronError:
                continue
            finally:
                driver.hold()
            reached = dict(zip(sent.names, sent.position.tolist(), strict=True))[gripper.joint]
            inside = ends[0] - 0.1 * travel <= reached <= ends[1] + 0.1 * travel
            require(inside, f"{gripper.joint} was sent to {reached:.3f}, its travel is {ends}")


SOURCE = "roboneuron.contract.protocols.RobotDriver"


def driver_rule(
    name: str, text: str, method: str, check: Callable[[RobotCase], None]
) -> Rule[RobotCase]:
    """A rule stated by a method of RobotDriver."""
    return Rule(id=f"driver/{name}", text=text, source=f"{SOURCE}.{method}", check=check)


RULES: tuple[Rule[RobotCase], ...] = (
    Rule(
        id="driver/target-callable",
        text="The driver's `target` and `config` can be imported.",
        source="roboneuron.plugins.specs.DriverSpec",
        check=_check_target,
    ),
    *LIFECYCLE.rules(),
    Rule(
        id="driver/constructor-leaves-topics",
        text="The constructor neither subscribes nor advertises.",
        source="roboneuron.contract.protocols.Topics",
        check=_check_topics_untouched,
    ),
    driver_rule(
        "reads-state",
        "After `open`, `read` returns finite numbers within the limits, of every arm joint, and "
        "the gripper's opening.",
        "read",
        _check_state,
    ),
    driver_rule("state-kept", "A returned state is not changed later.", "read", _check_state_kept),
    driver_rule(
        "stamps-in-ros-time",
        "States are stamped in nanoseconds of `Topics.now_ns`, advance, and never go back.",
        "read",
        _check_stamps,
    ),
    driver_rule("read-quick", "`read` does not block.", "read", _check_read_quick),
    driver_rule(
        "send-quick",
        "`send` starts a motion and does not wait for its end.",
        "send",
        _check_send_quick,
    ),
    driver_rule(
        "hold-quick",
        "`hold` does not wait until the robot stands.",
        "hold",
        _check_hold_quick,
    ),
    driver_rule(
        "bad-command-refused",
        "A command of unknown joints, a joint twice, unequal lengths, no duration or of NaN is "
        "refused and moves nothing.",
        "send",
        _check_bad_command,
    ),
    driver_rule(
        "limits-kept",
        "A position outside the limits of a joint or gripper is refused, or what is really sent is "
        "within them.",
        "send",
        _check_limits,
    ),
)
"""Rules of robot drivers, without those of `driver_motion`."""
