"""Rules of backends about rows executed during a prediction, and about predicted states."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rn_testing.cases import BackendCase
from rn_testing.rule import NotApplicable, Rule, require
from roboneuron import ActionChunk, Ahead, Backend, Observation

Predict = Callable[[BackendCase, Backend, Observation], ActionChunk]
COMMITTED = 3
"""Number of committed rows in a trial, if the descriptor and the chunk allow as many."""
LOOKS = 3
"""Predictions after a reset until a policy that first looks around acts."""
SAME = 1e-3
"""Tolerance of repeated predictions, for rounding of parallel sums on a GPU [m, rad, opening]."""
REACTS = 1e-6
"""Smallest difference that counts as a reaction to another state [m, rad, opening]."""
MOVED_M = 0.05
"""Displacement of the TCP in a predicted state."""


def _distance(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    return float(np.abs(one - other).max()) if one.shape == other.shape else np.inf


@dataclass(frozen=True, slots=True)
class ContinuingRules:
    """Builds the rules.

    Attributes:
        running: context manager with a loaded backend of a case.
        predict: predicts a chunk; raises if the result is none.
        rule: builds a rule from a name, a text, a source and a check.
    """

    running: Callable[[BackendCase], AbstractContextManager[Backend]]
    predict: Predict
    rule: Callable[[str, str, str, Callable[[BackendCase], None]], Rule[BackendCase]]

    def rules(self) -> tuple[Rule[BackendCase], ...]:
        """Return all these rules."""
        return (
            self.rule(
                "rows-kept",
                "A backend that declares `conditions_on_rows` keeps the committed rows within its "
                "case's "
                "`row_tolerance`, and says so in `conditioned_rows`.",
                "roboneuron.contract.observation.Ahead",
                self._check_rows_kept,
            ),
            self.rule(
                "ahead-optional",
                "A backend that declares `conditions_on_rows` answers without rows ahead, without "
                "their context and "
                "with none committed, and then says that it conditioned on none where it was "
                "given none.",
                "roboneuron.contract.observation.Observation",
                self._check_ahead_optional,
            ),
            self.rule(
                "ahead-ignored",
                "A backend that declares neither `conditions_on_rows` nor `takes_predicted_state` "
                "answers the same "
                "with `Observation.ahead` as without.",
                "roboneuron.plugins.specs.BackendSpec",
                self._check_ahead_ignored,
            ),
            self.rule(
                "predicted-state-used",
                "A backend that declares `takes_predicted_state` answers another TCP pose by "
                "other actions, and reads "
                "no joints: those cannot be predicted.",
                "roboneuron.plugins.specs.BackendSpec",
                self._check_predicted_state,
            ),
        )

    def _first(self, case: BackendCase, backend: Backend, observation: Observation) -> ActionChunk:
        """The first chunk after a reset."""
        backend.reset()
        return self.predict(case, backend, observation)

    def _running(self, case: BackendCase, backend: Backend) -> ActionChunk:
        """The chunk that is executed while the next one is computed; reproducible."""
        self._first(case, backend, case.observation())
        for _ in range(LOOKS - 2):
            self.predict(case, backend, case.observation())
        return self.predict(case, backend, case.observation())

    def _check_rows_kept(self, case: BackendCase) -> None:
        if not case.spec.conditions_on_rows:
            raise NotApplicable("it does not declare conditions_on_rows")
        tolerance = case.row_tolerance
        if tolerance is None and case.is_automatic:
            raise NotApplicable("only its own case can name a row_tolerance")
        require(
            tolerance is not None,
            "the descriptor declares conditions_on_rows, the case names no row_tolerance",
        )
        assert tolerance is not None
        # a new observation each time, because some backends refuse a frozen image
        with self.running(case) as backend:
            first = self._running(case, backend)
            free = self.predict(case, backend, case.next_observation())
            again = self._running(case, backend)
            ahead = _ahead_of(again, case.spec.max_committed_rows)
            bound = self.predict(case, backend, replace(case.next_observation(), ahead=ahead))
        count = ahead.committed_rows
        said = bound.conditioned_rows
        require(said >= count, f"{count} rows were committed, conditioned_rows says {said}")
        require(
            len(bound.actions) >= count,
            f"{count} rows were committed, the chunk has {len(bound.actions)}",
        )
        far = _distance(bound.actions[:count], ahead.rows[:count])
        require(
            far <= tolerance,
            f"the committed rows are {far:.3g} off, the case's row_tolerance is {tolerance:g}",
        )
        without = _distance(free.actions[:count], first.actions[1 : 1 + count])
        require(
            tolerance < without,
            f"a row_tolerance of {tolerance:g} tells nothing: without rows ahead they are "
            f"{without:.3g} off",
        )

    def _check_ahead_optional(self, case: BackendCase) -> None:
        if not case.spec.conditions_on_rows:
            raise NotApplicable("it does not declare conditions_on_rows")
        with self.running(case) as backend:
            first = self._running(case, backend)
            ahead = _ahead_of(first, case.spec.max_committed_rows)
            none = Ahead(
                rows=np.zeros((0, first.space.size)), committed_rows=0, step_s=first.step_s
            )
            for what, given in (
                ("without rows ahead", None),
                (
                    "without the context of the running chunk",
                    replace(ahead, context=None, context_row=0),
                ),
                ("with none committed", replace(ahead, committed_rows=0)),
                ("with no rows left", none),
                ("without rows ahead again", None),
            ):
                chunk = self.predict(case, backend, replace(case.observation(), ahead=given))
                if given is None or not len(given.rows):
                    said = chunk.conditioned_rows
                    require(said == 0, f"{what} the chunk says that it conditioned on {said} rows")

    def _check_ahead_ignored(self, case: BackendCase) -> None:
        if case.spec.conditions_on_rows or case.spec.takes_predicted_state:
            raise NotApplicable("it declares that it reads what is ahead")
        observation = case.observation()
        with self.running(case) as backend:
            alone = self._first(case, backend, observation)
            rows = np.tile([0.01, 0, 0, 0, 0, 0.01, 0.0], (4, 1))
            for context in (alone.context, None, {"of": "another"}):
                backend.reset()
                ahead = Ahead(
                    rows=rows,
                    committed_rows=2,
                    step_s=alone.step_s,
                    context=context,
                    state_ahead_s=0.1,
                )
                told = self.predict(case, backend, replace(observation, ahead=ahead))
                far = _distance(told.actions, alone.actions)
                require(
                    far <= SAME,
                    f"with rows ahead the chunk differs by {far:.3g}, and the descriptor says "
                    "nothing",
                )
                said = told.conditioned_rows
                require(
                    said == 0,
                    f"conditioned_rows is {said}, the descriptor declares no conditions_on_rows",
                )

    def _check_predicted_state(self, case: BackendCase) -> None:
        if not case.spec.takes_predicted_state:
            raise NotApplicable("it does not declare takes_predicted_state")
        require(
            case.spec.needs_state,
            "the descriptor declares takes_predicted_state and not needs_state",
        )
        whole = case.observation()
        pose, joints = whole.ee_pose, whole.joints
        if pose is None:
            raise NotApplicable("the case's observation has no pose")
        with self.running(case) as backend:
            measured = self._first(case, backend, whole)
            ahead = Ahead(
                rows=np.zeros((0, measured.space.size)),
                committed_rows=0,
                step_s=measured.step_s,
                state_ahead_s=0.1,
            )
            moved = replace(pose, position_m=pose.position_m + MOVED_M)
            rolled = self._first(case, backend, replace(whole, ee_pose=moved, ahead=ahead))
            far = _distance(rolled.actions, measured.actions)
            require(
                far > REACTS, f"for a TCP {MOVED_M:g} m away the chunk differs by {far:.3g} only"
            )
            if joints is not None:
                turned = replace(joints, position=joints.position + 0.1)
                same = self._first(case, backend, replace(whole, joints=turned))
                far = _distance(same.actions, measured.actions)
                require(
                    far <= SAME,
                    f"for other joints and the same TCP pose the chunk differs by {far:.3g}",
                )


def _ahead_of(chunk: ActionChunk, most: int) -> Ahead:
    """Context of a running chunk after its first row, with the next rows committed."""
    left = chunk.actions[1:]
    count = min(COMMITTED, len(left), most or COMMITTED)
    require(
        count > 0,
        "a chunk of one row cannot be continued, and the descriptor declares conditions_on_rows",
    )
    return Ahead(
        rows=left, committed_rows=count, step_s=chunk.step_s, context=chunk.context, context_row=1
    )
