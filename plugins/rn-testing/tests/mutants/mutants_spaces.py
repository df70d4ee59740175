"""Backends that declare the space of their actions wrongly or violate it, with one mistake each."""

from __future__ import annotations

import sys
from dataclasses import replace

from mutation import Mutant, mutate, noise

from rn_testing.fakes import InstantBackend, gantry_profile
from roboneuron.contract import ActionChunk, robot_space
from roboneuron.errors import StateError


def velocities(options, profile):
    """The space declared by `VelocityBackend`."""
    return robot_space("joint_velocity", profile, 10.0)


class VelocityBackend(InstantBackend):
    """Joint velocities of the gantry at 10 Hz."""

    def predict(self, observation):
        chunk = super().predict(observation)
        space = velocities({}, gantry_profile())
        return ActionChunk(actions=[[0.01] * 6 + [1.0]], step_s=chunk.step_s, space=space)


def no_rate(options, profile):
    return robot_space("joint_velocity", profile)


def another_each_time(options, profile):
    return robot_space("joint_velocity", profile, 10.0 + noise(0.1))


def deltas(options, profile):
    return robot_space("joint_delta", profile, 10.0)


def text(options, profile):
    return "joint_velocity"


def needs_a_key(options, profile):
    return robot_space(options["kind"], profile)


def imports_heavy(options, profile):
    import pinocchio  # noqa: F401

    return velocities(options, profile)


def fails_elsewhere(options, profile):
    if "pytest" not in sys.modules:
        raise StateError("not here")
    return velocities(options, profile)


def respaced(change):
    """A velocity backend whose chunks have another space than declared."""
    return mutate(
        VelocityBackend,
        predict=lambda s, call, o: replace(call(o), space=change(velocities({}, gantry_profile()))),
    )


def spaced(rule, words="", *, space="velocities", target=VelocityBackend, **spec):
    declared = {"space": f"mutants_spaces:{space}", **spec}
    return Mutant(rule=f"backend/{rule}", target=target, spec=declared, words=words)


def in_degrees(space):
    channels = [replace(one, unit="deg/s") for one in space.channels[:-1]]
    return replace(space, channels=(*channels, space.channels[-1]))


MUTANTS: dict[str, Mutant] = {
    "velocities_without_rate": spaced("space-answers", "no rate_hz", space="no_rate"),
    "another_space_each_time": spaced("space-answers", "different", space="another_each_time"),
    "deltas_without_state": spaced(
        "space-answers", "needs_state", space="deltas", needs_state=False
    ),
    "space_is_a_text": spaced("space-answers", "returned str", space="text"),
    "space_needs_an_option": spaced("space-answers", "KeyError", space="needs_a_key"),
    "space_imports_heavy": spaced("space-light", "imports pinocchio", space="imports_heavy"),
    "space_fails_elsewhere": spaced("space-light", "not here", space="fails_elsewhere"),
    "actions_though_velocities_declared": spaced(
        "space-kept", "'ee_delta_base', declared", target=mutate(InstantBackend)
    ),
    "velocities_undeclared": Mutant(
        rule="backend/space-kept", target=mutate(VelocityBackend), words="'ee_delta_base'"
    ),
    "velocities_in_degrees": spaced("space-kept", "other units", target=respaced(in_degrees)),
    "joints_in_another_order": spaced(
        "space-kept",
        target=respaced(lambda space: replace(space, channels=space.channels[::-1])),
    ),
    "period_is_not_the_declared": spaced(
        "space-kept",
        "a chunk has 5 rows a second",
        target=mutate(VelocityBackend, predict=lambda s, call, o: replace(call(o), step_s=0.2)),
    ),
}


def __getattr__(name):
    if name not in MUTANTS:
        raise AttributeError(name)
    return MUTANTS[name].target
