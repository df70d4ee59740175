"""Controllers that write into their inputs, or end elsewhere than their residual says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from mutants_controllers import but, sent
from mutation import Mutant

from roboneuron.contract import JointCommand


def stops_early(self, result, joints):
    """Ends 0.2 mm before its target and says nothing of it."""
    start = self._measured(joints)
    away = result.position[: len(start)] - start
    step = float(np.linalg.norm(away[:3]))
    kept = 1.0 if step < 1e-3 else 1 - 2e-4 / step
    position = result.position.copy()
    position[:3] = start[:3] + kept * away[:3]
    return replace(result, position=position)


def overwrite(joints, position):
    joints.position.flags.writeable = True
    joints.position[: len(position)] = position[: len(joints.position)]


def writes_target(self, call, action, joints, step_s):
    result = call(action, joints, step_s)
    if isinstance(result, JointCommand):
        overwrite(joints, result.position)
    return result


def writes_in_forward(self, call, joints):
    pose = call(joints)
    overwrite(joints, joints.position + 1e-9)
    return pose


MUTANTS: dict[str, Mutant] = {
    "residual_of_zero_for_a_solver_that_stops_early": but(
        "small-steps-arrive", compute=sent(stops_early)
    ),
    "writes_into_the_measured_joints": but("small-steps-arrive", compute=writes_target),
    "writes_into_the_joints_of_forward": but("forward-is-a-pose", forward=writes_in_forward),
}


def __getattr__(name):
    if name not in MUTANTS:
        raise AttributeError(name)
    return MUTANTS[name].target
