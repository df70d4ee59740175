"""Backends with one mistake each about continued rows or a predicted state."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from mutation import (
    Mutant,
    mutants_of,
    mutate,
    then,
)

from rn_testing.fakes import InstantBackend
from roboneuron.contract import ActionChunk

STILL = np.array([[0, 0, 0, 0, 0, 0, 1.0]])
but = mutants_of("backend", InstantBackend)


def plus(chunk, amount):
    return replace(chunk, actions=chunk.actions + amount * np.eye(7)[0])


class ContinuingBackend(InstantBackend):
    """A good backend: four rows that depend on image and pose, and continue the committed ones."""

    def predict(self, observation):
        """See `Backend.predict`."""
        step_s = super().predict(observation).step_s
        actions = np.tile(STILL, (4, 1))
        actions[:, 0] = 0.1 * observation.frames["primary"].image[0, 0, 0] / 255
        actions[:, 1] = 0.01 * observation.ee_pose.position_m[0]
        actions[:, 2] = 0.001 * np.arange(4)
        ahead = observation.ahead
        count = 0 if ahead is None or ahead.context != "own" else min(ahead.committed_rows, 4)
        if count:
            actions[:count] = ahead.rows[:count]
        return ActionChunk(actions=actions, step_s=step_s, context="own", conditioned_rows=count)


CONTINUING = {"conditions_on_rows": True}
PREDICTED = {"takes_predicted_state": True}


def continuing(rule, words="", *, spec=CONTINUING, case=None, **changes):
    case = {"row_tolerance": 1e-6} if case is None else case
    return Mutant(
        rule=f"backend/{rule}",
        target=mutate(ContinuingBackend, **changes),
        spec=spec,
        case=case,
        words=words,
    )


def forgets_rows(self, call, observation):
    ahead = observation.ahead
    free = call(replace(observation, ahead=None))
    return free if ahead is None else replace(free, conditioned_rows=ahead.committed_rows)


def one_row_late(self, call, observation):
    ahead = observation.ahead
    if ahead is None or not ahead.committed_rows:
        return call(observation)
    chunk = call(observation)
    return replace(chunk, actions=np.vstack((chunk.actions[:1], chunk.actions[:-1])))


def turns_with_joints(self, call, observation):
    return plus(call(observation), 0.1 * float(observation.joints.position[0]))


MUTANTS: dict[str, Mutant] = {
    "committed_rows_are_forgotten": continuing("rows-kept", "are 0.1 off", predict=forgets_rows),
    "committed_rows_are_kept_one_row_late": continuing(
        "rows-kept", "off, the case's", predict=one_row_late
    ),
    "conditioned_rows_are_not_told": continuing(
        "rows-kept",
        "conditioned_rows says 0",
        predict=lambda s, call, o: replace(call(o), conditioned_rows=0),
    ),
    "conditioned_rows_are_too_few": continuing(
        "rows-kept",
        "conditioned_rows says 1",
        predict=lambda s, call, o: replace(call(o), conditioned_rows=1 if o.ahead else 0),
    ),
    "declares_conditioning_and_has_one_row": continuing(
        "rows-kept",
        "one row",
        predict=lambda s, call, o: replace(call(o), actions=STILL, conditioned_rows=0),
    ),
    "no_row_tolerance_is_named": continuing(
        "rows-kept", "names no row_tolerance", case={"row_tolerance": None}
    ),
    "row_tolerance_allows_anything": continuing(
        "rows-kept", "tells nothing", case={"row_tolerance": 1.0}
    ),
    "declares_conditioning_and_does_none": but(
        "rows-kept", spec=CONTINUING, case={"row_tolerance": 1e-6, "options": {"horizon": 4}}
    ),
    "needs_rows_ahead": continuing(
        "ahead-optional", "AttributeError", predict=lambda s, call, o: then(o.ahead.rows, call(o))
    ),
    "needs_the_context": continuing(
        "ahead-optional",
        "AttributeError",
        predict=lambda s, call, o: then(o.ahead is None or o.ahead.context.upper(), call(o)),
    ),
    "needs_committed_rows": continuing(
        "ahead-optional",
        "ZeroDivision",
        predict=lambda s, call, o: then(o.ahead and 1 / o.ahead.committed_rows, call(o)),
    ),
    "needs_rows_to_be_left": continuing(
        "ahead-optional",
        "IndexError",
        predict=lambda s, call, o: then(o.ahead and o.ahead.rows[0], call(o)),
    ),
    "conditions_on_rows_of_before": continuing(
        "ahead-optional",
        "conditioned on 2 rows",
        predict=lambda s, call, o: call(o) if o.ahead else replace(call(o), conditioned_rows=2),
    ),
    "acts_on_rows_it_does_not_declare": but(
        "ahead-ignored",
        "differs by 0.01",
        predict=lambda s, call, o: plus(call(o), 0.01 if o.ahead else 0.0),
    ),
    "another_length_with_rows_ahead": but(
        "ahead-ignored",
        predict=lambda s, call, o: (
            replace(call(o), actions=np.repeat(STILL, 3, axis=0)) if o.ahead else call(o)
        ),
    ),
    "says_that_it_conditions_and_declares_nothing": but(
        "ahead-ignored",
        "conditioned_rows is 1",
        predict=lambda s, call, o: replace(call(o), conditioned_rows=1),
    ),
    "rows_ahead_crash": but(
        "ahead-ignored",
        predict=lambda s, call, o: then(o.ahead and o.ahead.context["own"], call(o)),
    ),
    "predicted_pose_is_ignored": but("predicted-state-used", "differs by 0 only", spec=PREDICTED),
    "predicted_pose_without_state": continuing(
        "predicted-state-used", "not needs_state", spec={**PREDICTED, "needs_state": False}
    ),
    "joints_are_read_where_the_pose_is_predicted": continuing(
        "predicted-state-used", "other joints", spec=PREDICTED, predict=turns_with_joints
    ),
}


def __getattr__(name):
    if name not in MUTANTS:
        raise AttributeError(name)
    return MUTANTS[name].target
