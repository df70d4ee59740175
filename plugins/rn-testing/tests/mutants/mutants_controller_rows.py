"""Controllers with one mistake each about rows of an action space."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from mutation import (
    Mutant,
    mutants_of,
)

from rn_testing.fakes import GantryController
from roboneuron.contract import Hold, JointCommand, robot_space
from roboneuron.errors import UnsafeError

but = mutants_of("controller", GantryController)


def row(change):
    """`execute` with another row, if any."""

    def execute(self, call, space, row, joints, step_s):
        return call(space, change(space, np.array(row), joints, step_s), joints, step_s)

    return execute


def only(kind, change):
    """Change rows of that kind."""
    return row(lambda space, row, joints, step_s: change(row) if space.kind == kind else row)


def velocities(change):
    return only("joint_velocity", lambda row: np.append(change(row[:6]), row[6:]))


def as_deltas(space, row, joints, step_s):
    if space.kind != "joint_position" or len(joints.names) < 6:
        return row
    return np.append(row[:6] + joints.position[:6], row[6:])


def measured_in_order(self, call, space, row, joints, step_s):
    known = set(self._profile.arm_joints) <= set(joints.names)
    names = (*self._profile.arm_joints, *joints.names[6:])
    return call(space, row, replace(joints, names=names) if known else joints, step_s)


def whole_second(self, call, space, row, joints, step_s):
    is_velocity = space.kind == "joint_velocity" and step_s > 0.0
    return call(space, row / step_s if is_velocity else row, joints, step_s)


def any_channels(self, call, space, row, joints, step_s):
    own = robot_space(space.kind, self._profile)
    fitted = np.resize(row, own.size) if space.keys != own.keys else row
    return call(own, fitted, joints, step_s)


def channels_by_name(self, call, space, row, joints, step_s):
    numbers = dict(zip(space.keys, row, strict=True))
    own = robot_space(space.kind, self._profile)
    return call(own, np.array([numbers[key] for key in own.keys]), joints, step_s)


def deltas_as_positions(self, call, space, row, joints, step_s):
    if space.kind == "joint_delta":
        space = robot_space("joint_position", self._profile)
        row = np.append(row[:6] + self._measured(joints), row[6:])
    return call(space, row, joints, step_s)


def raising_rows(self, call, space, row, joints, step_s):
    result = call(space, row, joints, step_s)
    if isinstance(result, Hold):
        raise UnsafeError(result.reason)
    return result


def a_tenth_at_least(self, call, space, row, joints, step_s):
    return call(space, row, joints, step_s if step_s > 0.0 else 0.1)


def jumps(self, call, space, row, joints, step_s):
    result = call(space, row, joints, step_s)
    if isinstance(result, JointCommand) or result.code != "joint_jump":
        return result
    target = self._measured(joints) + 0.5
    return JointCommand(names=self._profile.arm_joints, position=target, duration_s=9.0)


def without_gripper(self, call, space, row, joints, step_s):
    result = call(space, row, joints, step_s)
    if isinstance(result, Hold):
        return result
    return replace(result, names=result.names[:6], position=result.position[:6])


class WithoutExecute(GantryController):
    execute = None


MUTANTS: dict[str, Mutant] = {
    "spaces_without_execute": Mutant(
        rule="controller/spaces-executed", target=WithoutExecute, words="has no `execute`"
    ),
    "positions_taken_as_deltas": but(
        "spaces-executed", "away from its target", execute=row(as_deltas)
    ),
    "rows_from_joints_by_place": but("spaces-executed", execute=measured_in_order),
    "quaternions_begin_with_w": but(
        "spaces-executed",
        execute=only("ee_pose", lambda row: row[[0, 1, 2, 6, 3, 4, 5, 7]]),
    ),
    "poses_in_millimetres": but(
        "spaces-executed", execute=only("ee_pose", lambda row: row * [1e-3] * 3 + [1] * 5)
    ),
    "rows_open_what_they_close": but(
        "spaces-executed",
        "an opening of",
        execute=row(lambda space, row, *_: np.append(row[:-1], 1.0 - row[-1:])),
    ),
    "rows_without_gripper": but("spaces-executed", "an opening of", execute=without_gripper),
    "velocities_reversed": but("velocities-integrate", execute=velocities(lambda v: -v)),
    "velocities_in_degrees": but("velocities-integrate", execute=velocities(np.radians)),
    "velocities_for_a_second": but("velocities-integrate", execute=whole_second),
    "velocities_of_the_joint_before": but(
        "velocities-integrate", execute=velocities(lambda v: np.roll(v, 1))
    ),
    "velocities_without_sign": but("velocities-integrate", execute=velocities(np.abs)),
    "rows_by_place": but("foreign-rows-hold", "led to JointCommand", execute=any_channels),
    "rows_of_unknown_joints_raise": but(
        "foreign-rows-hold", "raised KeyError", execute=channels_by_name
    ),
    "deltas_are_positions": but("deltas-hold", execute=deltas_as_positions),
    "deltas_raise": but("deltas-hold", "raised UnsafeError", execute=raising_rows),
    "bad_rows_raise": but("bad-rows-hold", "raised UnsafeError", execute=raising_rows),
    "nan_in_a_row_is_zero": but(
        "bad-rows-hold", "of nan", execute=row(lambda space, row, *_: np.nan_to_num(row))
    ),
    "rows_without_time_get_some": but("bad-rows-hold", "step_s", execute=a_tenth_at_least),
    "far_rows_are_executed": but("row-jumps-harmless", "moves a joint by 0.5", execute=jumps),
}


def __getattr__(name):
    if name not in MUTANTS:
        raise AttributeError(name)
    return MUTANTS[name].target
