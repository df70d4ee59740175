"""Second module processes, by slot: started in shadow next to the working one, adopted or
discarded.
"""

from __future__ import annotations

import threading
from contextlib import suppress

from roboneuron.errors import StateError
from roboneuron.modules.settings import ModuleKind
from roboneuron.planning import Plan
from roboneuron.server.loop import ClosedLoop
from roboneuron.supervisor.changes import Stage
from roboneuron.supervisor.slot import Slot


class Standbys:
    """Standby processes of working modules; usable from any thread.

    It neither sends stop events nor withdraws the policy's instruction, because another process
    replaces the old one.
    """

    def __init__(self, loop: ClosedLoop) -> None:
        self._loop = loop
        self._modules = loop.modules

    def slots(self, kind: ModuleKind) -> tuple[Slot, ...]:
        """Slot of the module that works now, then those of its standbys."""
        with self._modules.changes.lock:
            return tuple(self._modules.slots[kind])

    def start(self, plan: Plan, on_stage: Stage, halt: threading.Event | None = None) -> Slot:
        """Start a second process in shadow of the running one; `adopt` or `discard` it afterwards.

        Args:
            halt: cancels the start when it is set.

        Raises:
            StateError: no module of that kind runs, or there is a standby already.
            RoboNeuronError: as `ClosedLoop.launch`.
        """
        kind, modules = plan.kind, self._modules
        standby = Slot(kind, modules.changes)
        with modules.changes.lock:
            working, *others = modules.slots[kind]
            working.check_running(f"Call start_{kind} first.")
            if others:
                raise StateError(
                    f"{kind} is already being replaced.", hint="Wait for the end of that call."
                )
            modules.slots[kind].append(standby)
        try:
            self._loop.launch(plan, on_stage, beside=standby, halt=halt)
        except BaseException:
            self._forget(standby)
            raise
        return standby

    def adopt(self, standby: Slot) -> Slot:
        """Make the standby the module of its kind; return the old slot, which has to be discarded.

        Raises:
            StateError: the old one is being stopped, or the standby is gone.
        """
        with self._modules.changes.lock:
            old = self._modules.slot(standby.kind)
            if old.phase != "running":
                raise StateError(f"{standby.kind} is {old.phase} now; nothing was replaced.")
            if standby.phase != "running":
                raise StateError(f"The new {standby.kind} is gone: {standby.explain_exit()}")
            self._modules.slots[standby.kind].reverse()
        self._modules.on_change(standby.kind)
        return old

    def discard(self, slot: Slot) -> None:
        """End a standby or a replaced module, if its process still exists."""
        try:
            with suppress(StateError):
                self._loop.end(slot)
        finally:
            self._forget(slot)

    def note_changed(self, slot: Slot, plan: Plan) -> None:
        """Set the plan of a module that was changed without a new process; a restart uses it too.

        Raises:
            StateError: it does not run any more.
        """
        with self._modules.changes.lock:
            slot.check_running()
            assert slot.settings is not None
            slot.plan = plan
            slot.settings = slot.settings.model_copy(update={"config": plan.config})
        self._modules.on_change(slot.kind)

    def _forget(self, slot: Slot) -> None:
        with self._modules.changes.lock:
            if slot in self._modules.slots[slot.kind][1:]:
                self._modules.slots[slot.kind].remove(slot)
