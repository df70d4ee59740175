"""A second process of a kind, beside the one that works: started in shadow, then adopted or
discarded.
"""

from __future__ import annotations

from contextlib import suppress

from roboneuron import StateError
from roboneuron.feature import Selection, Slot, Stage, Supervisor


def start_standby(supervisor: Supervisor, selection: Selection, on_stage: Stage) -> Slot:
    """Start a second process beside the running one, in shadow; `adopt` or `discard` it.

    Raises:
        StateError: nothing of that kind runs, or there is a standby already.
        RoboNeuronError: as `Supervisor.start`.
    """
    kind = selection.kind
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
        _forget(supervisor, standby)
        raise
    return standby


def adopt(supervisor: Supervisor, standby: Slot) -> Slot:
    """Make the standby the module of its kind; returns the old one, which is to be discarded.

    Raises:
        StateError: the old one is being stopped, or the standby is gone.
    """
    with supervisor.changes.lock:
        old = supervisor.slot(standby.kind)
        if old.phase != "running":
            raise StateError(f"{standby.kind} is {old.phase} now; nothing was replaced.")
        if standby.phase != "running":
            raise StateError(f"The new {standby.kind} is gone: {standby.explain_exit()}")
        supervisor.slots[standby.kind].reverse()
    supervisor.on_change(standby.kind)
    return old


def discard(supervisor: Supervisor, slot: Slot) -> None:
    """End a standby or a replaced module, if its process is still there."""
    try:
        with suppress(StateError):
            supervisor.end(slot)
    finally:
        _forget(supervisor, slot)


def _forget(supervisor: Supervisor, slot: Slot) -> None:
    with supervisor.changes.lock:
        if slot in supervisor.slots[slot.kind][1:]:
            supervisor.slots[slot.kind].remove(slot)
