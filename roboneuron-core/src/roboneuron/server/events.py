"""What happens in a server, told to whoever listens: modules and their health, stops, faults."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from roboneuron.gate.audit import AuditRecord
from roboneuron.modules.settings import ModuleKind
from roboneuron.supervisor.changes import Event
from roboneuron.supervisor.health import Health, ModuleView


class Events:
    """What happens in a server. Listeners are added while it is put together.

    Attributes:
        open: the server begins to serve; told first of all, before ROS is joined and features
            start.
        end: the server has closed everything; told last of all, possibly twice, and without `open`.
        health: the health of a module changed at most 30 ms ago; the module, how it was, and how it
            is.
        change: a module started, stopped or ended by itself.
        stop: a module is about to be stopped because somebody asked for it.
        tools: the tools that are listed changed; told from any thread.
        resource: the content of the resource with that URI changed; told from any thread.
        fault: a fault that is no module's health (a lapsed lease, a memory limit); the module, a
            word for the fault, and facts that JSON can hold.
        decision: the gate or the emergency stop of this process wrote a record; on the thread that
            asked.
        call: a tool was called and answered; its name, the arguments as sent, the client, the code
            of the error (empty when it succeeded), and how long it took [s].
        client: a client of several robots made a call of one of them (True), or a client has left
            (False).
        presence: a client has opened (1) or closed (-1) a request or a stream.
    """

    def __init__(self) -> None:
        self.open: Event[[]] = Event()
        self.end: Event[[]] = Event()
        self.health: Event[[ModuleView, Health, Health]] = Event()
        self.change: Event[[ModuleKind]] = Event()
        self.stop: Event[[ModuleKind]] = Event()
        self.tools: Event[[]] = Event()
        self.resource: Event[[str]] = Event()
        self.fault: Event[[str, str, Mapping[str, Any]]] = Event()
        self.decision: Event[[AuditRecord]] = Event()
        self.call: Event[[str, Mapping[str, Any], str, str, float]] = Event()
        self.client: Event[[str, bool]] = Event()
        self.presence: Event[[str, int]] = Event()
