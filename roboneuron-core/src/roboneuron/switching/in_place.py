"""Change of the acceleration in the running inference process, if nothing else changes and the
runtime supports it.
"""

from __future__ import annotations

from contextlib import suppress

from roboneuron.config.models import Config
from roboneuron.errors import NotReadyError, RefusedError, RoboNeuronError, StateError
from roboneuron.modules.inference.planning import InferencePlan
from roboneuron.modules.report import Report
from roboneuron.planning import Plan
from roboneuron.server.loop import ClosedLoop
from roboneuron.supervisor.changes import Stage
from roboneuron.supervisor.health import ModuleView
from roboneuron.supervisor.lifecycle import NodeClient
from roboneuron.supervisor.slot import Slot
from roboneuron.switching.beside import Standbys
from roboneuron.switching.gap import Gap, action_gap
from roboneuron.switching.standby import ACCELERATION_PARAMETER
from roboneuron.switching.warm_switch import ARRIVAL_S, Change

_TOLD_S = 5.0
_DONE_S = 20.0
"""Timeout, which includes the prediction in progress."""


def differs_in_acceleration_only(old: ModuleView, plan: Plan) -> bool:
    """True if the running backend only needs another acceleration, and supports the change."""
    if (
        plan.kind != "inference"
        or old.report is None
        or not isinstance(old.plan, InferencePlan)
        or not isinstance(plan, InferencePlan)
    ):
        return False
    before, after = old.plan.policy, plan.policy
    section = plan.config.inference
    return (
        old.report.metrics.get("acceleration_in_place") == "true"
        and before.acceleration != after.acceleration
        and (before.backend, before.runtime, before.cameras)
        == (after.backend, after.runtime, after.cameras)
        and _without_acceleration(old.plan.config) == _without_acceleration(plan.config)
        and section is not None
        and section.instruction == old.report.instruction
    )


def _without_acceleration(config: Config) -> Config:
    """Remove the acceleration, and the instruction, which may have changed since the start."""
    assert config.inference is not None
    section = config.inference.model_copy(update={"acceleration": None, "instruction": ""})
    return config.model_copy(update={"inference": section})


class AccelerationSwitch:
    """One change; used once, on the caller's thread."""

    def __init__(self, loop: ClosedLoop, plan: Plan, on_stage: Stage) -> None:
        self._loop = loop
        self._changes = loop.modules.changes
        self._standbys = Standbys(loop)
        self._plan = plan
        self._name = plan.names.get("acceleration", "")
        self._on_stage = on_stage

    def run(self) -> Change:
        """Request the change, and wait until the module has applied it; a later restart uses it
        too.

        Raises:
            RefusedError: the runtime refuses; the previous acceleration stays in force.
            NotReadyError: no answer in time; the previous one is requested again.
            StateError: the module is being stopped or replaced.
        """
        slot, *others = self._standbys.slots("inference")
        view = self._loop.modules.require_running("inference")
        if others:
            raise StateError(
                "inference is already being replaced.", hint="Wait for the end of that call."
            )
        assert view.report is not None
        former = view.report.metrics.get("acceleration", "")
        answers = _answers(view.report)
        self._on_stage(f"inference: changing the acceleration to {self._name or 'none'}")
        parameters = self._loop.parameters(slot)
        refused = parameters.set(
            {ACCELERATION_PARAMETER: self._name}, _TOLD_S, lambda: self._check(slot)
        )
        if refused:
            raise RefusedError(
                f"The running backend keeps its acceleration: {refused}.", rule="switch"
            )
        report = self._await_answer(slot, parameters, answers, former)
        if reason := report.metrics.get("acceleration_refused"):
            raise RefusedError(
                f"Acceleration {self._name or 'none'!r} was refused: {reason} "
                f"{former or 'none'!r} stays in force.",
                rule="switch",
            )
        self._standbys.note_changed(slot, self._plan)
        return Change(gap=self._gap(report), difference=None)

    def _await_answer(
        self, slot: Slot, parameters: NodeClient, answers: int, former: str
    ) -> Report:
        def answer() -> Report | None:
            report = slot.report
            return report if report is not None and _answers(report) > answers else None

        report = self._changes.wait_for(answer, _DONE_S, lambda: self._check(slot))
        if report is None:
            with suppress(RoboNeuronError):
                parameters.set({ACCELERATION_PARAMETER: former}, _TOLD_S)
            raise NotReadyError(
                f"The backend finished no prediction within {_DONE_S:g} s, so its acceleration was "
                "not changed.",
                hint="It may hang: see work_age_s in get_status.",
            )
        return report

    def _check(self, slot: Slot) -> None:
        slot.check_running()
        slot.check_alive("changing its acceleration")

    def _gap(self, report: Report) -> Gap | None:
        """The period in which it changed; None if nothing is sent."""
        if not report.instruction:
            return None
        stream = self._loop.stream(self._plan.config.namespace)
        changed_ns = int(report.metrics["acceleration_changed_ns"])
        return self._changes.wait_for(
            lambda: action_gap([at for at, _ in stream.copy()], changed_ns), ARRIVAL_S
        )


def _answers(report: Report) -> int:
    return int(report.metrics.get("acceleration_answers", "0"))
