"""Replacement of one module by another, warm or cold, and its reversal."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, replace
from typing import Literal

from roboneuron.errors import InvalidInputError, RoboNeuronError, StateError
from roboneuron.modules.report import Report
from roboneuron.modules.settings import ModuleKind
from roboneuron.planning import KIND_ENTRIES, Plan
from roboneuron.selection.requests import StartChosenInference, StartPerception
from roboneuron.server.loop import ClosedLoop
from roboneuron.server.tool import Arguments
from roboneuron.supervisor.changes import Stage
from roboneuron.supervisor.health import ModuleView
from roboneuron.switching.in_place import AccelerationSwitch, differs_in_acceleration_only
from roboneuron.switching.switch_checks import CHECKS, SwitchCheck
from roboneuron.switching.warm_switch import ARRIVAL_S, Change, WarmSwitch, check_goes_on

SwitchMode = Literal["warm", "cold"]
"""Requested mode of a switch."""
SwitchWay = Literal["warm", "cold", "in place"]
"""Mode that was used: a change that needs no other process is made in the running one, unless
"cold" was requested.
"""
_FIRST_S = 3.0
"""Timeout for the next input to reach a new module, on a busy machine too."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Switched:
    """Result of a switch.

    Attributes:
        view: the new module.
        replaced: chosen names of the old module.
        change: effect of the handover on the outputs.
        took_s: duration of the whole call, loading included.
    """

    view: ModuleView
    replaced: dict[str, str]
    mode: SwitchWay
    change: Change
    took_s: float


class Switching:
    """Replaces modules and stores the previous plans; usable from any thread.

    Modules that do not call `joining.join` can only be replaced cold, because they have no
    `TimedHandover`.
    """

    def __init__(self, loop: ClosedLoop) -> None:
        self.loop = loop
        self._before: dict[ModuleKind, Plan] = {}
        # tried without waiting: a second switch would begin from a module that is being replaced
        self._busy = {kind: threading.Lock() for kind in loop.modules.slots}

    def switch(
        self,
        kind: ModuleKind,
        request: Arguments,
        mode: SwitchMode = "warm",
        on_stage: Stage = lambda stage: None,
        role: str = "",
        halt: threading.Event | None = None,
    ) -> Switched:
        """Replace the running module of a kind, on the same topics.

        The instruction of a backend and the cameras of a source are kept unless the request names
        others. Errors that can be detected beforehand are raised while the old module works; after
        a failed warm switch it continues.

        Args:
            halt: set when the client cancels its call, which fails the switch until the handover.

        Raises:
            StateError: no module is running.
            RoboNeuronError: warm, nothing was replaced; cold, nothing of that kind runs any more.
        """
        old = self.loop.modules.require_running(kind)
        ticket, instruction = self.loop.starts.ticket, self.loop.starts.instruction
        plan = self.loop.select(kind, _keep(old, request), role)
        if isinstance(request, StartChosenInference):
            if request.instruction:
                self.loop.starts.permit()
            plan = with_instruction(plan, request.instruction or instruction)
            self.loop.check(plan)
        if kind == "control":
            check_same_commands(old, plan)
        return self._replace(old, plan, mode, on_stage, ticket, halt)

    def roll_back(
        self,
        kind: ModuleKind,
        mode: SwitchMode = "warm",
        on_stage: Stage = lambda stage: None,
        halt: threading.Event | None = None,
    ) -> Switched:
        """Return to the plan before the last switch; a backend keeps the present instruction.

        Raises:
            StateError: there was no switch.
            RoboNeuronError: as `switch`.
        """
        old = self.loop.modules.require_running(kind)
        plan = self._before.get(kind)
        if plan is None:
            raise StateError(
                f"There is no {KIND_ENTRIES[kind].noun} to go back to: none was replaced yet."
            )
        ticket = self.loop.starts.ticket
        if kind == "inference":
            plan = with_instruction(plan, self.loop.starts.instruction)
        self.loop.check(plan)
        return self._replace(old, plan, mode, on_stage, ticket, halt)

    def _replace(
        self,
        old: ModuleView,
        plan: Plan,
        mode: SwitchMode,
        on_stage: Stage,
        ticket: int,
        halt: threading.Event | None,
    ) -> Switched:
        started_s = time.monotonic()
        if not self._busy[old.kind].acquire(blocking=False):
            raise StateError(
                f"{old.kind} is already being replaced.", hint="Wait for the end of that call."
            )
        try:
            replaced = old.plan
            if replaced is None:
                raise StateError(f"It is not known what {old.kind} was started with.")
            way, change = self._change(old, replaced, plan, mode, on_stage, ticket, halt)
            self._before[old.kind] = replaced
        finally:
            self._busy[old.kind].release()
        return Switched(
            view=self.loop.modules.view(old.kind),
            replaced=dict(replaced.names),
            mode=way,
            change=change,
            took_s=time.monotonic() - started_s,
        )

    def _change(
        self,
        old: ModuleView,
        replaced: Plan,
        plan: Plan,
        mode: SwitchMode,
        on_stage: Stage,
        ticket: int,
        halt: threading.Event | None,
    ) -> tuple[SwitchWay, Change]:
        check_goes_on(halt)
        if mode == "warm" and differs_in_acceleration_only(old, plan):
            return "in place", AccelerationSwitch(self.loop, plan, on_stage).run()
        check = CHECKS[old.kind](self.loop, plan)
        if mode == "warm":
            return mode, WarmSwitch(self.loop, plan, check, on_stage, ticket, halt).run()
        return mode, self._cold(replaced, plan, check, on_stage, ticket, halt)

    def _cold(
        self,
        replaced: Plan,
        plan: Plan,
        check: SwitchCheck,
        on_stage: Stage,
        ticket: int,
        halt: threading.Event | None,
    ) -> Change:
        """Stop the old module, then start the new one: for a machine or device without memory for
        both.
        """
        kind = check.kind
        due = check.is_due()
        on_stage(f"{kind}: stopping the old {check.noun}")
        stopped = self.loop.end(kind)
        last = stopped.report
        # a stop, or the end of a task
        if kind == "inference" and self.loop.starts.ticket != ticket:
            plan = with_instruction(plan, self.loop.starts.instruction)
            due = due and bool(self.loop.starts.instruction)
        try:
            self.loop.start_selected(plan, on_stage, halt)
        except RoboNeuronError as error:
            before = ", ".join(f"{key} {name!r}" for key, name in replaced.names.items())
            raise error.with_hint(
                f"No {check.noun} is running now; before there was {before}."
            ) from error
        changes = self.loop.modules.changes
        if due:  # a start is complete before the first output if that needs another module's input
            changes.wait_for(
                lambda: (new := self._newest(kind)) is not None and check.has_taken_over(new),
                _FIRST_S,
            )
        gap = changes.wait_for(lambda: check.measure(last, self._newest(kind)), ARRIVAL_S)
        return Change(gap=gap, difference=None)

    def _newest(self, kind: ModuleKind) -> Report | None:
        return self.loop.modules.view(kind).report


def check_same_commands(old: ModuleView, plan: Plan) -> None:
    """Refuse two controllers with different command topics, which cannot hand over the arm.

    Raises:
        InvalidInputError: the type of the command topic would change.
    """
    assert old.plan is not None
    before, after = old.plan.config.control, plan.config.control
    if before is not None and after is not None and before.command != after.command:
        raise InvalidInputError(
            f"The running controller sends {before.command}, the new one would send "
            f"{after.command}.",
            hint="Call stop_control and start_control instead.",
        )


def with_instruction(plan: Plan, text: str) -> Plan:
    """Return the plan with that instruction; the configured one applies only to a requested start
    of the policy.
    """
    section = plan.config.inference
    assert section is not None
    config = plan.config.model_copy(
        update={"inference": section.model_copy(update={"instruction": text.strip()})}
    )
    return replace(plan, config=config)


def _keep(old: ModuleView, request: Arguments) -> Arguments:
    """Add the running module's options to a request, where the request sets no others."""
    assert old.plan is not None
    if isinstance(request, StartPerception) and not request.cameras:
        section = old.plan.config.perception
        return request.model_copy(
            update={"cameras": list(section.cameras) if section is not None else []}
        )
    return request
