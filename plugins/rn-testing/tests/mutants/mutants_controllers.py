"""Controllers with one mistake each."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from mutation import (
    Mutant,
    compute,
    counted,
    forever,
    leave_thread,
    mutants_of,
    mutate,
    noise,
    or_else,
    read_file,
    remembered,
    then,
)

from rn_testing.fakes import GantryController
from roboneuron.contract import Hold, JointCommand
from roboneuron.contract.rotation import matrix_from_quaternion
from roboneuron.errors import UnsafeError

but = mutants_of("controller", GantryController)


def sent(change):
    """`compute` with a changed command."""

    def compute(self, call, action, joints, step_s):
        result = call(action, joints, step_s)
        return result if isinstance(result, Hold) else change(self, result, joints)

    return compute


def asked(change):
    """`compute` with another action."""

    def compute(self, call, action, joints, step_s):
        return call(change(self, action, joints), joints, step_s)

    return compute


def turned(action, joints, controller):
    rotation = matrix_from_quaternion(controller.forward(joints).quaternion_xyzw)
    moved, turn = rotation @ action.translation_m, rotation @ action.rotation_rad
    return replace(action, translation_m=moved, rotation_rad=turn)


def tool_frame(self, action, joints):
    return or_else(lambda: turned(action, joints, self), lambda: action) if self._loaded else action


def clamped(self, call, action, joints, step_s):
    result = call(action, joints, step_s)
    if isinstance(result, JointCommand) or result.code in ("bad_state", "bad_action"):
        return result
    here = self._measured(joints)
    return JointCommand(names=self._profile.arm_joints, position=here + 0.01, duration_s=step_s)


def clamped_to_limits(self, call, action, joints, step_s):
    result = call(action, joints, step_s)
    if isinstance(result, JointCommand) or result.code != "joint_limit":
        return result
    here, limits = self._measured(joints), self._profile.limits
    target = np.clip(here + action.to_vector()[:6], limits.lower, limits.upper)
    return JointCommand(names=self._profile.arm_joints, position=target, duration_s=step_s)


def beyond_limits(self, call, action, joints, step_s):
    result = call(action, joints, step_s)
    if isinstance(result, JointCommand) or result.code != "joint_limit":
        return result
    here = self._measured(joints)
    return JointCommand(
        names=self._profile.arm_joints, position=here + action.to_vector()[:6], duration_s=step_s
    )


def blind(code):
    def compute(self, call, action, joints, step_s):
        result = call(action, joints, step_s)
        if isinstance(result, JointCommand) or result.code != code:
            return result
        return JointCommand(
            names=self._profile.arm_joints, position=self._profile.home_rad, duration_s=0.1
        )

    return compute


def raising(self, call, action, joints, step_s):
    result = call(action, joints, step_s)
    if isinstance(result, Hold):
        raise UnsafeError(result.reason)
    return result


def in_profile_order(self, call, action, joints, step_s):
    order = replace(joints, names=(*self._profile.arm_joints, *joints.names[6:]))
    return call(action, order if len(joints.names) > 6 else joints, step_s)


def forward_in_order(self, call, joints):
    return call(
        replace(joints, names=(*self._profile.arm_joints, *joints.names[6:]))
        if len(joints.names) > 6
        else joints
    )


def integrates(self, call, action, joints, step_s):
    result = call(action, getattr(self, "goal", None) or joints, step_s)
    if isinstance(result, JointCommand):
        self.goal = replace(joints, names=result.names, position=result.position, velocity=None)
    return result


def without_joints(n):
    return lambda s, c, j: replace(c, names=c.names[:n], position=c.position[:n])


def forward_nan(self, call, joints):
    return call(replace(joints, position=np.nan_to_num(joints.position, posinf=0.0), velocity=None))


def far_accepted(self, call, action, joints, step_s):
    result = call(action, joints, step_s)
    if isinstance(result, Hold) and result.code == "joint_jump":
        names, limits = self._profile.arm_joints, self._profile.limits
        target = np.clip(
            self._measured(joints) + action.to_vector()[:6], limits.lower, limits.upper
        )
        return JointCommand(
            names=names, position=target, duration_s=99.0, residual_m=9.0, residual_rad=9.0
        )
    return result


NAMES = ("__init__", "load", "compute", "close")


MUTANTS: dict[str, Mutant] = {
    "no_forward": Mutant(
        rule="controller/protocol", target=mutate(object, **{n: lambda *_: None for n in NAMES})
    ),
    "constructor_reads_a_file": but(
        "constructor-pure", __init__=lambda s, call, *a: then(call(*a), read_file())
    ),
    "constructor_starts_a_thread": but(
        "constructor-pure", __init__=lambda s, call, *a: then(call(*a), leave_thread())
    ),
    "constructor_computes": but(
        "constructor-pure", __init__=lambda s, call, *a: then(call(*a), compute())
    ),
    "options_ignored": but(
        "options-read", spec={"config": "rn_testing.fakes.backend:InstantOptions"}
    ),
    "close_needs_load": but(
        "close-before-load", close=lambda s, call: call() if s._loaded else s.forward(None)
    ),
    "close_takes_20_s": but(
        "close-releases", "close did not return", case={"limits_s": {"close": 0.3}}, close=forever
    ),
    "close_leaves_a_thread": but(
        "close-releases", load=lambda s, call: then(call(), leave_thread())
    ),
    "second_load_starts_another_thread": but(
        "second-load-safe",
        load=lambda s, call: then(call(), leave_thread() if counted(s) > 1 else 0),
    ),
    "load_after_close_is_half": but(
        "load-after-close", load=lambda s, call: call() if counted(s) < 2 else None
    ),
    "every_action_is_kept": but(
        "memory-bounded", compute=lambda s, call, *a: remembered(s, call(*a))
    ),
    "holds_before_load": but(
        "compute-before-load-refused",
        compute=lambda s, call, *a: or_else(
            lambda: call(*a), lambda: Hold(code="not_loaded", reason="no")
        ),
    ),
    "computes_after_close": but("compute-after-close-refused", close=lambda s, call: None),
    "forward_before_load": but(
        "forward-before-load-refused",
        forward=lambda s, call, j: then(setattr(s, "_loaded", True), call(j)),
    ),
    "forward_after_close": but("forward-after-close-refused", close=lambda s, call: None),
    "compute_hangs": but(
        "small-steps-arrive",
        "compute did not return",
        case={"limits_s": {"compute": 0.3}},
        compute=forever,
    ),
    "compute_is_slow": but(
        "compute-quick", compute=lambda s, call, *a: then(time.sleep(0.1), call(*a))
    ),
    "forward_is_slow": but(
        "compute-quick", forward=lambda s, call, j: then(time.sleep(0.1), call(j))
    ),
    "quaternion_of_length_2": but(
        "forward-is-a-pose",
        forward=lambda s, call, j: replace(call(j), quaternion_xyzw=2 * call(j).quaternion_xyzw),
    ),
    "quaternion_wxyz": but(
        "forward-is-a-pose",
        forward=lambda s, call, j: replace(
            call(j), quaternion_xyzw=np.roll(call(j).quaternion_xyzw, 1)
        ),
    ),
    "quaternion_of_the_inverse": but(
        "forward-is-a-pose",
        forward=lambda s, call, j: replace(
            call(j), quaternion_xyzw=call(j).quaternion_xyzw * [-1, -1, -1, 1]
        ),
    ),
    "forward_in_millimetres": but(
        "forward-is-a-pose",
        forward=lambda s, call, j: replace(call(j), position_m=1000 * call(j).position_m),
    ),
    "forward_of_another_link": but(
        "forward-is-a-pose",
        forward=lambda s, call, j: replace(call(j), position_m=call(j).position_m + 0.1),
    ),
    "forward_unstamped": but(
        "forward-is-a-pose", forward=lambda s, call, j: replace(call(j), stamp_ns=0)
    ),
    "forward_accepts_nan": but("forward-refuses-bad-joints", forward=forward_nan),
    "forward_crashes_without_a_joint": but(
        "forward-refuses-bad-joints",
        forward=lambda s, call, j: then(j.names.index("slide_x"), call(j)),
    ),
    "tool_frame": but("small-steps-arrive", compute=asked(tool_frame)),
    "millimetres": but(
        "small-steps-arrive",
        compute=asked(lambda s, a, j: replace(a, translation_m=a.translation_m / 1000)),
    ),
    "degrees": but(
        "small-steps-arrive",
        compute=asked(lambda s, a, j: replace(a, rotation_rad=np.degrees(a.rotation_rad))),
    ),
    "inverted": but(
        "small-steps-arrive",
        compute=asked(lambda s, a, j: replace(a, translation_m=-a.translation_m)),
    ),
    "rotation_ignored": but(
        "small-steps-arrive",
        compute=asked(lambda s, a, j: replace(a, rotation_rad=0 * a.rotation_rad)),
    ),
    "axes_swapped": but(
        "small-steps-arrive",
        compute=asked(lambda s, a, j: replace(a, translation_m=a.translation_m[[1, 0, 2]])),
    ),
    "gain_of_a_half": but(
        "small-steps-arrive",
        compute=asked(lambda s, a, j: replace(a, translation_m=a.translation_m / 2)),
    ),
    "names_and_positions_disagree": but(
        "small-steps-arrive", compute=sent(lambda s, c, j: replace(c, names=c.names[::-1]))
    ),
    "refuses_all": but(
        "small-steps-arrive", compute=sent(lambda s, c, j: Hold(code="shy", reason="no"))
    ),
    "residual_covers_everything": but(
        "small-steps-arrive",
        compute=sent(
            lambda s, c, j: replace(
                c, position=np.append(s._measured(j), 0.04), residual_m=1.0, residual_rad=1.0
            )
        ),
    ),
    "residual_of_nan": but(
        "small-steps-arrive", compute=sent(lambda s, c, j: replace(c, residual_m=float("nan")))
    ),
    "duration_fixed": but(
        "small-steps-arrive", compute=sent(lambda s, c, j: replace(c, duration_s=0.1))
    ),
    "duration_in_milliseconds": but(
        "small-steps-arrive",
        compute=sent(lambda s, c, j: replace(c, duration_s=c.duration_s * 1000)),
    ),
    "duration_zero": but(
        "small-steps-arrive", compute=sent(lambda s, c, j: replace(c, duration_s=0.0))
    ),
    "joint_twice": but(
        "small-steps-arrive",
        compute=sent(
            lambda s, c, j: replace(
                c, names=(c.names[0], *c.names), position=np.append(c.position[0], c.position)
            )
        ),
    ),
    "foreign_joint": but(
        "small-steps-arrive",
        compute=sent(lambda s, c, j: replace(c, names=("elbow", *c.names[1:]))),
    ),
    "position_of_nan": but(
        "small-steps-arrive", compute=sent(lambda s, c, j: replace(c, position=c.position * np.nan))
    ),
    "dictionary_instead_of_a_command": but(
        "small-steps-arrive",
        compute=sent(lambda s, c, j: dict(zip(c.names, c.position, strict=True))),
    ),
    "nothing_returned": but("small-steps-arrive", compute=lambda s, call, *a: then(call(*a), None)),
    "zero_drifts": but(
        "zero-stands-still", compute=sent(lambda s, c, j: replace(c, position=c.position + 0.005))
    ),
    "nan_joint_goes_home": but("bad-numbers-hold", compute=blind("bad_state")),
    "nan_action_goes_home": but("bad-numbers-hold", compute=blind("bad_action")),
    "nan_opening_accepted": but(
        "bad-numbers-hold",
        compute=asked(
            lambda s, a, j: replace(
                a, gripper_open=float(np.nan_to_num(a.gripper_open, posinf=1.0))
            )
        ),
    ),
    "bad_numbers_raise": but("bad-numbers-hold", "raised", compute=raising),
    "no_time_crashes": but(
        "bad-numbers-hold",
        "ZeroDivisionError",
        compute=lambda s, call, a, j, t: then(1 / t, call(a, j, t)),
    ),
    "no_time_accepted": but(
        "bad-numbers-hold", compute=lambda s, call, a, j, t: call(a, j, t if t > 0 else 0.1)
    ),
    "nan_velocity_crashes": but(
        "bad-numbers-hold",
        "ValueError",
        compute=lambda s, call, a, j, t: then(
            None if j.velocity is None or np.isfinite(j.velocity).all() else int("nan"),
            call(a, j, t),
        ),
    ),
    "hold_without_a_reason": but(
        "bad-numbers-hold",
        compute=lambda s, call, *a: (
            r if isinstance(r := call(*a), JointCommand) else Hold(code=r.code, reason="")
        ),
    ),
    "unreachable_clamped": but("far-targets-harmless", compute=clamped),
    "unreachable_accepted": but("far-targets-harmless", "was not refused", compute=far_accepted),
    "limits_ignored": but("limits-kept", compute=beyond_limits),
    "limits_clamped_in_silence": but("limits-kept", "ends", compute=clamped_to_limits),
    "velocity_limits_ignored": but(
        "velocity-kept",
        compute=lambda s, call, a, j, t: (
            r if isinstance(r := call(a, j, t), Hold) else replace(r, duration_s=t)
        ),
    ),
    "gripper_inverted": but(
        "gripper-commanded",
        compute=asked(lambda s, a, j: replace(a, gripper_open=1 - a.gripper_open)),
    ),
    "gripper_not_scaled": but(
        "gripper-commanded",
        compute=lambda s, call, a, j, t: (
            r
            if isinstance(r := call(a, j, t), Hold)
            else replace(r, position=np.append(r.position[:6], a.gripper_open))
        ),
    ),
    "gripper_only_opens": but(
        "gripper-commanded", compute=asked(lambda s, a, j: replace(a, gripper_open=1.0))
    ),
    "gripper_left_out": but("gripper-commanded", compute=sent(without_joints(6))),
    "joints_in_the_order_of_the_profile": but("joints-by-name", compute=in_profile_order),
    "forward_in_the_order_of_the_profile": but("joints-by-name", forward=forward_in_order),
    "integrates_its_own_commands": but("memoryless", compute=integrates),
    "noise": but(
        "memoryless",
        compute=sent(lambda s, c, j: replace(c, position=c.position + noise(1e-5))),
    ),
    "counts_its_calls": but(
        "memoryless",
        compute=sent(lambda s, c, j: replace(c, position=c.position + 1e-6 * counted(s))),
    ),
    "any_profile_accepted": but(
        "bad-profile-refused", load=lambda s, call: setattr(s, "_loaded", True)
    ),
    "bad_profile_crashes": but(
        "bad-profile-refused",
        load=lambda s, call: then(s._profile.urdf.index(f'"{s._profile.tcp_link}"'), call()),
    ),
}


def __getattr__(name):
    if name not in MUTANTS:
        raise AttributeError(name)
    return MUTANTS[name].target
