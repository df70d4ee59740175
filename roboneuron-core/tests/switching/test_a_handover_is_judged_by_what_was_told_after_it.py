"""A handover on a busy machine: what a new module has done counts, however late it says so, and it
may answer late.
"""

from __future__ import annotations

import threading
import time
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any, cast

import pytest

from roboneuron.errors import NotReadyError, RefusedError, StateError
from roboneuron.modules.report import Report
from roboneuron.supervisor.changes import Changes
from roboneuron.switching import warm_switch
from roboneuron.switching.standby import ACT_FROM, PLAY_FROM
from roboneuron.switching.warm_switch import WarmSwitch

FIRST_S, BRIDGED_NS = 0.1, 40_000_000


def switch_of(machine: object, check: object) -> WarmSwitch:
    def parameters(slot: object) -> object:
        return machine.parameters(slot)  # type: ignore[attr-defined]

    loop = SimpleNamespace(modules=machine, starts=None, parameters=parameters)
    return WarmSwitch(cast(Any, loop), cast(Any, None), cast(Any, check), lambda stage: None)


class Machine:
    """An old and a new process, which report when the test says so."""

    def __init__(self) -> None:
        self.changes = Changes()
        self.slot = SimpleNamespace(check_alive=lambda doing: None, phase="running")
        self.slot.report = Report(received_s=time.monotonic())
        self.slots: Any = {"control": [self.slot], "inference": [self.slot]}

    def tell(self, delay_s: float, **metrics: str) -> None:
        def now() -> None:
            self.slot.report = Report(received_s=time.monotonic(), metrics=metrics)
            self.changes.notify()

        threading.Timer(delay_s, now).start()


def first_output(machine: Machine) -> None:
    check = SimpleNamespace(
        kind="control", noun="controller", has_taken_over=lambda new: "acted" in new.metrics
    )
    switch = switch_of(machine, check)
    switch._await_first_output(cast(Any, machine.slots["control"][0]), time.monotonic(), 0.0)


@pytest.fixture(autouse=True)
def _short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(warm_switch, "_FIRST_S", FIRST_S)
    monkeypatch.setattr(warm_switch, "_TOLD_S", 20.0)


def test_a_report_that_comes_late_counts() -> None:
    machine = Machine()
    machine.tell(10 * FIRST_S, acted="yes")
    first_output(machine)


def test_one_that_reports_and_has_not_acted_is_undone_at_once() -> None:
    machine = Machine()
    machine.tell(2 * FIRST_S)
    started_s = time.monotonic()
    with pytest.raises(NotReadyError, match="did not act"):
        first_output(machine)
    assert time.monotonic() - started_s < 15.0


def test_one_that_has_fallen_silent_is_undone_in_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(warm_switch, "_TOLD_S", FIRST_S)
    with pytest.raises(NotReadyError, match="did not act"):
        first_output(Machine())


@pytest.mark.parametrize(
    ("kind", "old", "new", "is_refused"),
    [
        ("control", "", "", False),
        ("control", "a lead", "", True),
        ("control", "a lead", "a lead", False),
        ("control", "", "a lead", False),
        ("inference", "a lead", "", False),
    ],
)
def test_a_stop_that_only_the_old_one_knows_is_not_lost(
    kind: str, old: str, new: str, is_refused: bool
) -> None:
    machine = Machine()
    check = SimpleNamespace(kind=kind, noun="controller")
    switch = switch_of(machine, check)
    machine.slot.report = Report(received_s=1.0, needs_start=old)
    standby: Any = SimpleNamespace(report=Report(received_s=1.0, needs_start=new))
    refused = pytest.raises(StateError, match="a lead; nothing was replaced")
    with refused if is_refused else nullcontext():
        switch._check_stops(standby)


class Client:
    """Hears moments; the first `late` answers do not come in time."""

    def __init__(self, late: int) -> None:
        self.late = late
        self.heard: list[tuple[float, float]] = []
        self.bridged_ns = -1

    def send(self, values: dict[str, int]) -> float:
        self.heard.append((time.time_ns() / 1e9, values[ACT_FROM] / 1e9))
        self.bridged_ns = values[PLAY_FROM] - values[ACT_FROM]
        return 0.0

    def finish(self, call: float, timeout_s: float, check: object) -> str:
        if len(self.heard) <= self.late:
            raise NotReadyError("It did not take its parameters in time.")
        return ""


def agree(client: Client) -> tuple[int, float]:
    machine = Machine()
    check = SimpleNamespace(kind="control", noun="controller")
    switch = switch_of(machine, check)
    return switch._agree(cast(Any, client), cast(Any, machine.slots["control"][0]), 0.5, BRIDGED_NS)


@pytest.mark.parametrize(("has_rows", "bridged_ns"), [(True, 125_000_000), (False, 0)])
def test_the_new_one_waits_for_rows_of_the_old_one_where_there_are_any(
    has_rows: bool, bridged_ns: int
) -> None:
    check = SimpleNamespace(kind="inference", has_rows=lambda: has_rows)
    switch = switch_of(Machine(), check)
    assert switch._bridged_ns(0.12) == bridged_ns


def test_one_that_answers_too_late_is_told_a_later_moment() -> None:
    client = Client(late=2)
    moment_ns, due_s = agree(client)
    assert [round(moment_s - sent_s, 1) for sent_s, moment_s in client.heard] == [0.5, 1.0, 2.0]
    assert moment_ns / 1e9 == client.heard[-1][1]
    assert due_s > time.monotonic()
    assert client.bridged_ns == BRIDGED_NS


def test_one_that_never_answers_in_time_is_not_waited_for_any_longer() -> None:
    client = Client(late=10)
    with pytest.raises(NotReadyError):
        agree(client)
    assert len(client.heard) == 3


def test_an_old_one_that_cannot_go_on_is_told_beside_the_cause_and_the_cause_stays_as_it_was(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    machine = Machine()
    check = SimpleNamespace(kind="control", noun="controller", latency_s=lambda new: 0.1)
    switch = switch_of(machine, check)
    cause = RefusedError("The new one broke.", hint="Look at it.")
    clients = [Client(late=10), Client(late=10)]
    machine.parameters = lambda slot: clients.pop()  # type: ignore[attr-defined]
    monkeypatch.setattr(switch, "_probe", lambda clients, standby: 0.5)
    monkeypatch.setattr(switch, "_bridged_ns", lambda latency_s: 0)
    monkeypatch.setattr(Client, "send", lambda self, values: 0.0)

    def fail(*_: object) -> None:
        raise cause

    monkeypatch.setattr(switch, "_agree", fail)
    with pytest.raises(RefusedError) as told:
        switch._hand_over(cast(Any, machine.slots["control"][0]))
    assert told.value.hint == (
        "Look at it. The old one could not be told to go on either: It did not take its "
        "parameters in time."
    )
    assert (told.value.__cause__, cause.hint) == (cause, "Look at it.")
