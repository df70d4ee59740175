"""Rules of controllers: small actions are executed or refused, checked with the URDF; limits and
speeds are respected.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from rn_testing.cases import ControllerCase
from rn_testing.commands import (
    TRUTH_M,
    TRUTH_RAD,
    by_name,
    check_arrives,
    check_command,
    distance,
    home_sample,
    make_action,
    postures,
)
from rn_testing.effects import expect_refusal
from rn_testing.kinematics import place_tcp
from rn_testing.lifecycle import Lifecycle
from rn_testing.rule import NotApplicable, Rule, Violation, require
from rn_testing.snapshots import snapshot
from roboneuron import (
    Action,
    Controller,
    Hold,
    JointCommand,
    JointSample,
    RoboNeuronError,
    UnsafeError,
)

STEP_S = 0.1
"""Time for an action in the rules [s]."""
SPEED_M_S, SPEED_RAD_S = 0.1, 0.3
"""Speeds of the TCP that every arm can reach."""
RESIDUAL_M, RESIDUAL_RAD = 5e-3, 0.05
"""Largest residual of a small step; a command that ends farther from its target must be refused."""
STILL = 1e-3
"""Tolerated joint motion for a zero action [rad or m]."""


def _load(case: ControllerCase, controller: Controller) -> None:
    controller.load()


_NOTHING = JointSample(names=(), position=np.zeros(0))


def _forward_nothing(case: ControllerCase, controller: Controller) -> object:
    return controller.forward(_NOTHING)


def _compute_nothing(case: ControllerCase, controller: Controller) -> object:
    return controller.compute(make_action(0.001), _NOTHING, STEP_S)


LIFECYCLE: Lifecycle[ControllerCase, Controller] = Lifecycle(
    subject="controller",
    protocol=Controller,
    begin="load",
    start=_load,
    uses={
        "compute": lambda case, controller: controller.compute(
            make_action(0.001), home_sample(case.robot()), STEP_S
        ),
        "forward": lambda case, controller: controller.forward(home_sample(case.robot())),
    },
    abuses=(_forward_nothing, _compute_nothing),
)
"""Start and use of a controller."""
loaded = LIFECYCLE.running


def compute(
    controller: Controller, action: Action, joints: JointSample, step_s: float = STEP_S
) -> JointCommand | Hold:
    """Call `compute`; check that a refusal has a reason, and that the input is not changed."""
    before = snapshot((action, joints))
    result = controller.compute(action, joints, step_s)
    require(snapshot((action, joints)) == before, "compute changed the action or measured joints")
    require(isinstance(result, (JointCommand, Hold)), f"compute returned {type(result).__name__}")
    if isinstance(result, Hold):
        require(bool(result.code and result.reason.strip()), "a Hold has no code or no reason")
    return result


def _check_forward(case: ControllerCase) -> None:
    profile = case.robot()
    with loaded(case) as controller:
        for posture in postures(profile):
            sample = replace(posture, stamp_ns=123)
            before = snapshot(sample)
            pose = controller.forward(sample)
            require(snapshot(sample) == before, "forward changed the measured joints")
            require(
                bool(np.isfinite(pose.position_m).all()) and pose.position_m.shape == (3,),
                f"forward: {pose.position_m}",
            )
            norm = float(np.linalg.norm(pose.quaternion_xyzw))
            require(
                abs(norm - 1) < 1e-6,
                f"forward returned a quaternion of length {norm:g}, expected 1",
            )
            require(
                pose.stamp_ns == 123,
                f"forward stamped the pose {pose.stamp_ns}, the joints are stamped 123",
            )
            off_m, off_rad = distance(pose, place_tcp(profile, by_name(posture)))
            require(
                off_m <= TRUTH_M and off_rad <= TRUTH_RAD,
                f"forward is {off_m:.4f} m and {off_rad:.4f} rad from where the URDF puts "
                f"{profile.tcp_link!r} "
                f"in {profile.base_link!r}",
            )


def damaged(joints: JointSample) -> dict[str, JointSample]:
    """Copies of the sample with one fault each, by the fault."""
    found = {
        "a joint missing": replace(
            joints, names=joints.names[1:], position=joints.position[1:], velocity=None
        )
    }
    for index in (0, 1):
        for number in (np.nan, np.inf):
            position = joints.position.copy()
            position[index] = number
            found[f"joint {joints.names[index]!r} of {number}"] = replace(joints, position=position)
    return found


def _check_forward_bad(case: ControllerCase) -> None:
    joints = home_sample(case.robot())
    with loaded(case) as controller:
        for name, bad in damaged(joints).items():
            expect_refusal(lambda j=bad: controller.forward(j), f"forward with {name}", UnsafeError)  # type: ignore[misc]


def _check_small_step(case: ControllerCase) -> None:
    profile = case.robot()
    with loaded(case) as controller:
        for joints in postures(profile):
            for step_s in (0.05, 0.2):
                sizes = np.repeat([SPEED_M_S * step_s, SPEED_RAD_S * step_s], 3)
                for axis in range(6):
                    action = make_action(*(sizes * np.eye(6)[axis]))
                    command = compute(controller, action, joints, step_s)
                    if isinstance(command, Hold):
                        raise Violation(
                            f"a step of {action.to_vector()[:6]} was refused: {command.reason}"
                        )
                    check_command(command, joints, profile, step_s)
                    check_arrives(command, action, joints, profile)
                    far = command.residual_m > RESIDUAL_M or command.residual_rad > RESIDUAL_RAD
                    require(
                        not far,
                        f"a small step leaves {command.residual_m:g} m and "
                        f"{command.residual_rad:g} rad",
                    )


def _check_still(case: ControllerCase) -> None:
    joints = home_sample(case.robot())
    with loaded(case) as controller:
        command = compute(controller, make_action(), joints)
    if isinstance(command, Hold):
        return
    measured = by_name(joints)
    for name, position in by_name(command).items():
        moved = abs(position - measured[name])
        require(moved <= STILL, f"an action of zero moves {name} by {moved:.4f}")


def _check_bad_numbers(case: ControllerCase) -> None:
    profile = case.robot()
    joints = home_sample(profile)
    bad = [(name, make_action(0.001), sample, STEP_S) for name, sample in damaged(joints).items()]
    for number in (np.nan, np.inf):
        wrong = np.full(3, number)
        bad.append(
            (
                f"a translation of {number}",
                replace(make_action(), translation_m=wrong),
                joints,
                STEP_S,
            )
        )
        bad.append(
            (f"a rotation of {number}", replace(make_action(), rotation_rad=wrong), joints, STEP_S)
        )
        bad.append(
            (
                f"an opening of {number}",
                replace(make_action(), gripper_open=float(number)),
                joints,
                STEP_S,
            )
        )
    bad += [
        (f"step_s {step_s:g}", make_action(0.001), joints, step_s)
        for step_s in (0.0, -0.1, float("nan"))
    ]
    with loaded(case) as controller:
        for name, action, sample, step_s in bad:
            try:
                result = compute(controller, action, sample, step_s)
            except Violation:
                raise
            except Exception as error:
                raise Violation(
                    f"compute with {name} raised {type(error).__name__}: {error}"
                ) from error
            require(
                isinstance(result, Hold), f"{name} led to {type(result).__name__}, expected Hold"
            )
        results = [
            compute(controller, make_action(0.001), replace(joints, velocity=velocity))
            for velocity in (np.full(len(joints.names), np.nan), None)
        ]
    for result in results:
        if isinstance(result, JointCommand):
            check_command(result, joints, profile, STEP_S)
    require(
        isinstance(results[-1], JointCommand), "without measured velocities a small step is refused"
    )


def _check_gripper(case: ControllerCase) -> None:
    profile = case.robot()
    gripper = profile.gripper
    if gripper is None:
        raise NotApplicable("the robot has no gripper")
    with loaded(case) as controller:
        for opening in (0.0, 0.3, 1.0):
            result = compute(controller, make_action(opening=opening), home_sample(profile))
            if isinstance(result, Hold):
                raise Violation(
                    f"an action that only sets the gripper to {opening:g} was refused: "
                    f"{result.reason}"
                )
            sent = by_name(result).get(gripper.joint)
            wanted = gripper.to_position(opening)
            good = sent is not None and abs(sent - wanted) <= 0.01 * abs(
                gripper.open_position - gripper.closed_position
            )
            require(
                good,
                f"an opening of {opening:g} sends {gripper.joint!r} to {sent}, expected {wanted:g}",
            )


def _check_by_name(case: ControllerCase) -> None:
    profile = case.robot()
    joints = home_sample(profile)
    order = list(reversed(range(len(joints.names))))
    more = (*(joints.names[i] for i in order), "another_joint")
    mixed = JointSample(
        names=more,
        position=np.append(joints.position[order], 9.0),
        velocity=np.zeros(len(more)),
        stamp_ns=joints.stamp_ns,
    )
    action = make_action(0.003, -0.002, 0.001)
    with loaded(case) as controller:
        straight, turned = controller.forward(joints), controller.forward(mixed)
        results = [compute(controller, action, sample) for sample in (joints, mixed)]
    require(
        max(distance(straight, turned)) <= 1e-6,
        "forward depends on the order of the measured joints",
    )
    require(
        type(results[0]) is type(results[1]), "compute depends on the order of the measured joints"
    )
    first, second = ({} if isinstance(r, Hold) else by_name(r) for r in results)
    same = first.keys() == second.keys() and all(abs(first[n] - second[n]) <= 1e-9 for n in first)
    require(same, "compute depends on the order of the measured joints")


def _check_bad_profile(case: ControllerCase) -> None:
    profile = case.robot()
    for what, bad in {
        "a TCP link that the URDF lacks": replace(profile, tcp_link="no_such_link"),
        "joints that the URDF lacks": replace(
            profile, arm_joints=("no_such_joint", *profile.arm_joints[1:])
        ),
        "a URDF that is not valid XML": replace(profile, urdf="<robot"),
    }.items():
        odd = replace(case, profile=lambda p=bad: p)  # type: ignore[misc]

        def load(case: ControllerCase = odd) -> None:
            controller = LIFECYCLE.built(case)
            try:
                controller.load()
            finally:
                controller.close()

        expect_refusal(load, f"load with {what}", RoboNeuronError)


_SOURCE = "roboneuron.contract.protocols.Controller"


def controller_rule(
    name: str,
    text: str,
    check: Callable[[ControllerCase], None],
    source: str = f"{_SOURCE}.compute",
) -> Rule[ControllerCase]:
    """A rule of controllers."""
    return Rule(id=f"controller/{name}", text=text, source=source, check=check)


RULES: tuple[Rule[ControllerCase], ...] = (
    *LIFECYCLE.rules(),
    controller_rule(
        "forward-is-a-pose",
        "`forward` returns the pose that the URDF gives, a unit quaternion and the stamp of the "
        "joints.",
        _check_forward,
        f"{_SOURCE}.forward",
    ),
    controller_rule(
        "forward-refuses-bad-joints",
        "`forward` raises UnsafeError for joints that are missing or not finite.",
        _check_forward_bad,
        f"{_SOURCE}.forward",
    ),
    controller_rule(
        "small-steps-arrive",
        "A slow step from home or nearby yields a command within limits that ends where its "
        "residual says.",
        _check_small_step,
    ),
    controller_rule(
        "zero-stands-still",
        "An action of zero moves no joint.",
        _check_still,
        "roboneuron.contract.action",
    ),
    controller_rule(
        "bad-numbers-hold",
        "`compute` holds with a reason, and never raises, for missing or non-finite numbers "
        "and invalid times; it needs no velocities.",
        _check_bad_numbers,
    ),
    controller_rule(
        "gripper-commanded",
        "The gripper's joint is sent to the position of the action's opening.",
        _check_gripper,
        "roboneuron.contract.profile.GripperProfile",
    ),
    controller_rule(
        "joints-by-name",
        "Measured joints are taken by name, in any order; other joints are ignored.",
        _check_by_name,
    ),
    controller_rule(
        "bad-profile-refused",
        "A profile that does not describe an arm is refused.",
        _check_bad_profile,
        f"{_SOURCE}.load",
    ),
)
"""Rules of controllers, without those of the other modules on controllers."""
