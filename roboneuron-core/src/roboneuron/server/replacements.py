"""What a feature that replaces or restarts modules may ask for; starts on behalf of clients are
`ClosedLoop.start`.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

from roboneuron.config import Config
from roboneuron.errors import StateError
from roboneuron.modules.report import Report
from roboneuron.modules.settings import ModuleKind
from roboneuron.server.selection import Selection
from roboneuron.supervisor.health import ModuleView, Stopped
from roboneuron.supervisor.launching import Stage
from roboneuron.supervisor.lifecycle import NodeClient
from roboneuron.supervisor.slot import Slot
from roboneuron.supervisor.supervisor import Supervisor


class Replacements:
    """Module processes by slot: the one that works, and one beside it; usable from any thread.

    Nothing here tells listeners of stops, nor takes the policy's instruction back: whoever asks
    puts another process in the place of the old one.
    """

    def __init__(self, supervisor: Supervisor) -> None:
        self._supervisor = supervisor

    def join(self, function: str) -> None:
        """Have each module that starts from now on call `function`, "module:attribute", with its
        host; see `FeatureSpec.on_join`.
        """
        if function not in self._supervisor.on_join:
            self._supervisor.on_join += (function,)

    def slots(self, kind: ModuleKind) -> tuple[Slot, ...]:
        """The slot of the module that works now, then those beside it."""
        with self._supervisor.changes.lock:
            return tuple(self._supervisor.slots[kind])

    def report_of(self, slot: Slot) -> Report | None:
        """The newest report of a module, standby or not."""
        return self._supervisor.report_of(slot)

    def parameters(self, slot: Slot) -> NodeClient:
        """The parameters of the module in a slot. Raises StateError: its process has ended."""
        return self._supervisor.parameters(slot)

    def start_again(self, view: ModuleView, config: Config) -> None:
        """Start once more what has ended, as it was chosen, with `config`. Raises as
        `Supervisor.start`.
        """
        section = getattr(config, view.kind)
        self._supervisor.start(
            view.kind,
            config,
            python=section.python if section is not None else None,
            names=view.choice.names if view.choice is not None else None,
            plan=view.choice.plan if view.choice is not None else None,
        )

    def end(self, kind: ModuleKind) -> Stopped | None:
        """End the module that works, and a start in progress. Raises as `Supervisor.stop`."""
        return self._supervisor.stop(kind)

    def start_standby(self, selection: Selection, on_stage: Stage) -> Slot:
        """Start a second process beside the running one, in shadow; `adopt` or `discard` it.

        Raises:
            StateError: nothing of that kind runs, or there is a standby already.
            RoboNeuronError: as `Supervisor.start`.
        """
        kind, supervisor = selection.kind, self._supervisor
        standby = Slot(kind, supervisor.changes)
        with supervisor.changes.lock:
            working, *others = supervisor.slots[kind]
            working.check_running(f"Call start_{kind} first.")
            if others:
                raise StateError(
                    f"{kind} is already being replaced.", hint="Wait for the end of that call."
                )
            supervisor.slots[kind].append(standby)
        try:
            supervisor.start(
                kind,
                selection.config,
                python=selection.python,
                names=selection.names,
                plan=selection.plan,
                on_stage=on_stage,
                beside=standby,
            )
        except BaseException:
            self._forget(standby)
            raise
        return standby

    def adopt(self, standby: Slot) -> Slot:
        """Make the standby the module of its kind; returns the old one, which is to be discarded.

        Raises:
            StateError: the old one is being stopped, or the standby is gone.
        """
        supervisor = self._supervisor
        with supervisor.changes.lock:
            old = supervisor.slot(standby.kind)
            if old.phase != "running":
                raise StateError(f"{standby.kind} is {old.phase} now; nothing was replaced.")
            if standby.phase != "running":
                raise StateError(f"The new {standby.kind} is gone: {standby.explain_exit()}")
            supervisor.slots[standby.kind].reverse()
        supervisor.on_change(standby.kind)
        return old

    def discard(self, slot: Slot) -> None:
        """End a standby or a replaced module, if its process is still there."""
        try:
            with suppress(StateError):
                self._supervisor.end(slot)
        finally:
            self._forget(slot)

    def note_changed(self, slot: Slot, selection: Selection) -> None:
        """The module in a slot has become what `selection` says, without another process; a restart
        uses it too.

        Raises:
            StateError: it does not run any more.
        """
        with self._supervisor.changes.lock:
            slot.check_running()
            assert slot.choice is not None
            settings = slot.choice.settings.model_copy(update={"config": selection.config})
            slot.choice = replace(
                slot.choice, settings=settings, names=selection.names, plan=selection.plan
            )
        self._supervisor.on_change(slot.kind)

    def _forget(self, slot: Slot) -> None:
        with self._supervisor.changes.lock:
            if slot in self._supervisor.slots[slot.kind][1:]:
                self._supervisor.slots[slot.kind].remove(slot)
