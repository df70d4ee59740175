"""Rules of controllers: small actions arrive or are refused with a truth, bad numbers hold, nothing is remembered."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from roboneuron.contract import Action, Controller, Hold, JointCommand, JointSample, Pose, RobotProfile, apply_delta
from roboneuron.contract.rotation import matrix_from_quaternion, rotvec_from_matrix
from roboneuron.errors import StateError, UnsafeError
from roboneuron.testing.cases import ControllerCase
from roboneuron.testing.effects import expect_refusal
from roboneuron.testing.lifecycle import (
    attempt,
    check_close_before_start,
    check_close_twice_and_release,
    check_protocol,
    check_pure_constructor,
    started,
)
from roboneuron.testing.rule import Rule, Violation, require

STEP_S = 0.1
"""Time the rules give each action."""
TRUTH_M, TRUTH_RAD = 5e-4, 5e-3
"""How far a command may end from what its residual says: the residual is compared, so this only covers rounding and
solvers that stop early."""
STILL = 2e-3
"""How far a joint may move for an action of zero [rad or m]."""
MAX_STEP = 0.3
"""Largest change of a joint by one action [rad or m]. Source: the project's rule that no step jumps configuration."""


@contextmanager
def _loaded(case: ControllerCase) -> Iterator[Controller]:
    with started(case, case.build, lambda controller: controller.load()) as controller:
        yield controller


def home_sample(profile: RobotProfile) -> JointSample:
    """The joints of `profile` at home, the gripper's included, open."""
    if profile.home_rad is None or profile.limits is None:
        raise Violation("the case's profile has no home posture or no limits")
    names, position = profile.arm_joints, profile.home_rad
    if profile.gripper is not None:
        names, position = (*names, profile.gripper.joint), np.append(position, profile.gripper.open_position)
    return JointSample(names=names, position=position, velocity=np.zeros(len(names)), stamp_ns=1)


def _action(*values: float) -> Action:
    padded = np.zeros(7)
    padded[: len(values)] = values
    padded[6] = 1.0
    return Action.from_vector(padded)


def _check_command(command: JointCommand, profile: RobotProfile) -> None:
    """Names, sizes, finiteness, limits and duration."""
    known = set(profile.arm_joints) | ({profile.gripper.joint} if profile.gripper else set())
    foreign = [n for n in command.names if n not in known]
    require(not foreign, f"a command names joints that the profile lacks: {', '.join(foreign)}")
    require(command.position.shape == (len(command.names),), f"a command has positions {command.position.shape}")
    require(bool(np.isfinite(command.position).all()), "a command holds a position that is not finite")
    require(command.duration_s > 0, f"a command lasts {command.duration_s} s, expected more than 0")
    limits = profile.limits
    assert limits is not None
    sent = dict(zip(command.names, command.position.tolist(), strict=True))
    for name, low, high in zip(profile.arm_joints, limits.lower.tolist(), limits.upper.tolist(), strict=True):
        if name in sent:
            require(
                low <= sent[name] <= high, f"{name} is sent to {sent[name]:.4f}, its limits are {low:g} .. {high:g}"
            )


def _reached(controller: Controller, command: JointCommand, start: JointSample) -> Pose:
    """Where the TCP is when the command has been carried out."""
    positions = dict(zip(start.names, start.position.tolist(), strict=True))
    positions.update(zip(command.names, command.position.tolist(), strict=True))
    sample = replace(start, names=tuple(positions), position=np.array(list(positions.values())), velocity=None)
    return controller.forward(sample)


def _distance(a: Pose, b: Pose) -> tuple[float, float]:
    turn = matrix_from_quaternion(a.quaternion_xyzw).T @ matrix_from_quaternion(b.quaternion_xyzw)
    return float(np.linalg.norm(a.position_m - b.position_m)), float(np.linalg.norm(rotvec_from_matrix(turn)))


def _check_protocol(case: ControllerCase) -> None:
    check_protocol(attempt(case, case.build), Controller)


def _check_pure(case: ControllerCase) -> None:
    check_pure_constructor(case, case.build)


def _check_close_first(case: ControllerCase) -> None:
    check_close_before_start(case, case.build)


def _check_release(case: ControllerCase) -> None:
    check_close_twice_and_release(case, case.build, lambda controller: controller.load())


def _check_compute_first(case: ControllerCase) -> None:
    controller = attempt(case, case.build)
    joints = home_sample(case.robot())
    try:
        expect_refusal(lambda: controller.compute(_action(), joints, STEP_S), "compute before load", StateError)
    finally:
        controller.close()


def _check_forward(case: ControllerCase) -> None:
    joints = replace(home_sample(case.robot()), stamp_ns=123)
    with _loaded(case) as controller:
        pose = controller.forward(joints)
    require(bool(np.isfinite(pose.position_m).all()) and pose.position_m.shape == (3,), f"forward: {pose.position_m}")
    norm = float(np.linalg.norm(pose.quaternion_xyzw))
    require(abs(norm - 1) < 1e-6, f"forward returned a quaternion of length {norm:g}, expected 1")
    require(pose.stamp_ns == 123, f"forward stamped the pose {pose.stamp_ns}, the joints are stamped 123")


def _check_forward_bad(case: ControllerCase) -> None:
    joints = home_sample(case.robot())
    with _loaded(case) as controller:
        for name, bad in _damaged(joints).items():
            expect_refusal(lambda j=bad: controller.forward(j), f"forward with {name}", UnsafeError)  # type: ignore[misc]


def _damaged(joints: JointSample) -> dict[str, JointSample]:
    nan = joints.position.copy()
    nan[0] = np.nan
    return {
        "a joint of NaN": replace(joints, position=nan),
        "a joint missing": replace(joints, names=joints.names[1:], position=joints.position[1:], velocity=None),
    }


def _check_small_step(case: ControllerCase) -> None:
    profile = case.robot()
    joints = home_sample(profile)
    steps = [_action(*(0.002 * np.eye(6)[axis])) for axis in range(3)]
    steps += [_action(*(0.01 * np.eye(6)[axis])) for axis in range(3, 6)]
    with _loaded(case) as controller:
        start = controller.forward(joints)
        for action in steps:
            command = controller.compute(action, joints, STEP_S)
            if isinstance(command, Hold):
                raise Violation(f"a step of {action.to_vector()[:6]} from home was refused: {command.reason}")
            _check_command(command, profile)
            error_m, error_rad = _distance(_reached(controller, command, joints), apply_delta(start, action))
            require(
                error_m <= command.residual_m + TRUTH_M and error_rad <= command.residual_rad + TRUTH_RAD,
                f"a step of {action.to_vector()[:6]} ends {error_m:.5f} m and {error_rad:.4f} rad from its target, "
                f"the command says {command.residual_m:.5f} m and {command.residual_rad:.4f} rad",
            )


def _check_still(case: ControllerCase) -> None:
    joints = home_sample(case.robot())
    with _loaded(case) as controller:
        command = controller.compute(_action(), joints, STEP_S)
    if isinstance(command, Hold):
        return
    measured = dict(zip(joints.names, joints.position.tolist(), strict=True))
    for name, position in zip(command.names, command.position.tolist(), strict=True):
        moved = abs(position - measured[name])
        require(moved <= STILL, f"an action of zero moves {name} by {moved:.4f}")


def _check_bad_numbers(case: ControllerCase) -> None:
    joints = home_sample(case.robot())
    nan = Action(translation_m=np.full(3, np.nan), rotation_rad=np.zeros(3), gripper_open=1.0)
    with _loaded(case) as controller:
        results = {name: controller.compute(_action(0.001), bad, STEP_S) for name, bad in _damaged(joints).items()}
        results["an action of NaN"] = controller.compute(nan, joints, STEP_S)
    for name, result in results.items():
        require(isinstance(result, Hold), f"{name} led to {type(result).__name__}, expected Hold")
        require(isinstance(result, Hold) and bool(result.code and result.reason), f"{name}: a Hold without reason")


def _check_far(case: ControllerCase) -> None:
    profile = case.robot()
    joints = home_sample(profile)
    with _loaded(case) as controller:
        for values in ((5.0,), (0, 0, -5.0), (0, 0, 0, 3.0, 0, 0)):
            result = controller.compute(_action(*values), joints, STEP_S)
            if isinstance(result, JointCommand):
                _check_command(result, profile)
                step = float(
                    np.abs(_arm(result, profile) - home_sample(profile).position[: len(profile.arm_joints)]).max()
                )
                require(step <= MAX_STEP, f"an action of {values} moves a joint by {step:.2f} in {STEP_S} s")


def _arm(command: JointCommand, profile: RobotProfile) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    home = home_sample(profile)
    sent = dict(zip(home.names, home.position.tolist(), strict=True))
    sent.update(zip(command.names, command.position.tolist(), strict=True))
    return np.array([sent[n] for n in profile.arm_joints])


def _check_memoryless(case: ControllerCase) -> None:
    joints = home_sample(case.robot())
    kept = joints.position.copy()
    action = _action(0.003, -0.002, 0.001)
    with _loaded(case) as controller:
        first = controller.compute(action, joints, STEP_S)
        controller.compute(_action(-0.004, 0.001, 0.002), joints, STEP_S)
        again = controller.compute(action, joints, STEP_S)
    require(bool(np.array_equal(kept, joints.position)), "compute wrote into the measured joints")
    require(type(first) is type(again), "the same input led to a command once and to Hold once")
    if isinstance(first, JointCommand) and isinstance(again, JointCommand):
        drift = float(np.abs(first.position - again.position).max())
        require(drift <= 1e-9, f"the same input led to commands that differ by {drift:g}")


_SOURCE = "roboneuron.contract.protocols.Controller"

RULES: tuple[Rule[ControllerCase], ...] = (
    Rule(id="controller/protocol", text="It has the methods of Controller.", source=_SOURCE, check=_check_protocol),
    Rule(
        id="controller/constructor-pure",
        text="The constructor opens no file, starts no thread or process and computes nothing that takes time.",
        source="roboneuron.contract.protocols",
        check=_check_pure,
    ),
    Rule(
        id="controller/close-before-load",
        text="`close` may be called twice and before `load`.",
        source=f"{_SOURCE}.close",
        check=_check_close_first,
    ),
    Rule(
        id="controller/close-releases",
        text="After `load`, `close` may be called twice and leaves no thread or process behind.",
        source=f"{_SOURCE}.close",
        check=_check_release,
    ),
    Rule(
        id="controller/compute-before-load-refused",
        text="`compute` before `load` is a StateError.",
        source=f"{_SOURCE}.compute",
        check=_check_compute_first,
    ),
    Rule(
        id="controller/forward-is-a-pose",
        text="`forward` returns a finite pose with a unit quaternion and the stamp of the joints.",
        source=f"{_SOURCE}.forward",
        check=_check_forward,
    ),
    Rule(
        id="controller/forward-refuses-bad-joints",
        text="`forward` raises UnsafeError for joints that are missing or not finite.",
        source=f"{_SOURCE}.forward",
        check=_check_forward_bad,
    ),
    Rule(
        id="controller/small-steps-arrive",
        text="A step of 2 mm or 10 mrad from home yields a command within limits that ends where its residual says.",
        source=f"{_SOURCE}.compute",
        check=_check_small_step,
    ),
    Rule(
        id="controller/zero-stands-still",
        text="An action of zero moves no joint.",
        source="roboneuron.contract.action",
        check=_check_still,
    ),
    Rule(
        id="controller/bad-numbers-hold",
        text="`compute` holds, and says why, for joints or actions that are missing or not finite; it never raises.",
        source=f"{_SOURCE}.compute",
        check=_check_bad_numbers,
    ),
    Rule(
        id="controller/far-targets-harmless",
        text="A target out of reach is refused, or the command stays within the limits and 0.3 rad per joint.",
        source=f"{_SOURCE}.compute",
        check=_check_far,
    ),
    Rule(
        id="controller/memoryless",
        text="The same action and joints yield the same command, and the input is not written to.",
        source=f"{_SOURCE}.compute",
        check=_check_memoryless,
    ),
)
"""Rules of controllers."""
