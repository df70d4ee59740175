"""A lead ends when somebody else becomes the operator, because its rows are calls that go on, and
when the call that began it is cancelled.
"""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rn_standard.http.operator_lease import OperatorLease
from rn_standard.teleoperation.lead import Lead
from rn_standard.teleoperation.rows import Acting, LeadRow
from rn_standard.teleoperation.samples import LeadSample
from rn_standard.teleoperation.session import LeadSession, LeadSpeeds
from rn_standard.teleoperation.tools import LeadArm, LeadResult, lead_tools
from rn_testing.fakes import gantry_profile
from rn_testing.waiting import wait_until
from roboneuron.feature import TimedCommand

AHEAD = np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0])
EXPOSED: Any = SimpleNamespace(robot="gantry", endpoint=SimpleNamespace(name="lead"))


class Source:
    """A person who holds the switch."""

    def __init__(self) -> None:
        self.closed = threading.Event()
        self._number = 0

    def read(self, timeout_s: float) -> LeadSample:
        time.sleep(min(timeout_s, 0.002))
        self._number += 1
        return LeadSample(number=self._number, at_s=time.monotonic(), is_held=True, twist=AHEAD)

    def close(self) -> None:
        self.closed.set()


class Gate:
    """Keeps what is sent."""

    def __init__(self) -> None:
        self.rows: list[LeadRow] = []

    def newest_joints(self, exposed: object) -> None:
        return None

    def play(
        self,
        exposed: object,
        request: object,
        commands: Iterator[TimedCommand],
        *,
        halt: threading.Event,
        **_: object,
    ) -> None:
        for command in commands:
            if halt.is_set():
                return
            if command.message is not None:
                self.rows.append(LeadRow.from_message(command.message))


@pytest.fixture
def lease() -> OperatorLease:
    audit: Any = SimpleNamespace(write=lambda record: None)
    return OperatorLease(None, audit, on_lapse=lambda reason: None)


def made_lead(
    gate: Gate,
    source: Source,
    context: Any,
    halt: threading.Event,
    ended: threading.Event,
    may_lead: Callable[[], object] = lambda: None,
) -> Lead:
    session = LeadSession("one", "person", gantry_profile(), LeadSpeeds(), time.monotonic())
    return Lead(
        session,
        source,  # type: ignore[arg-type]
        "page",
        gate,  # type: ignore[arg-type]
        EXPOSED,
        context,
        may_lead,
        lambda _: ended.set(),
        halt,
    )


def test_a_lead_ends_when_another_client_takes_over(lease: OperatorLease) -> None:
    context: Any = SimpleNamespace(who="first", role="operator", simulated=False)
    tool = lead_tools(None, None, dict)[0]  # type: ignore[arg-type]
    lease.admit(tool, context)
    gate, source, ended, halt = Gate(), Source(), threading.Event(), threading.Event()
    lead = made_lead(gate, source, context, halt, ended, lambda: lease.admit(tool, context))
    thread = threading.Thread(target=lead._run)
    thread.start()
    try:
        wait_until(lambda: len(gate.rows) > 5, 10.0)
        assert lead.is_running
        lease.take_over("second", "operator")
        assert ended.wait(10.0)
    finally:
        halt.set()
        thread.join(10.0)
    assert "'second' operates the robot" in lead.reason
    assert gate.rows[-1].mode == "lost"
    assert source.closed.is_set()


class CancelledContext:
    """A call that is cancelled just after its work is done."""

    simulated = False

    who, role = "first", "operator"

    async def run(
        self, work: Callable[[Any], object], *, on_cancel: Callable[[], object] = lambda: None
    ) -> None:
        await asyncio.get_running_loop().run_in_executor(None, work, lambda _: None)
        on_cancel()
        raise asyncio.CancelledError


def test_a_lead_ends_when_the_call_that_begins_it_is_cancelled() -> None:
    gate, source, ended = Gate(), Source(), threading.Event()
    leads: list[Lead] = []

    def begin(arguments: LeadArm, context: Any, halt: threading.Event) -> LeadResult:
        leads.append(made_lead(gate, source, context, halt, ended))
        leads[0].note(Acting(who="person", session="one", number=1))
        leads[0].begin()
        return LeadResult()

    tool = lead_tools(begin, None, dict)[0]  # type: ignore[arg-type]
    context: Any = CancelledContext()

    async def call() -> None:
        await tool.handler(LeadArm(source="page"), context)

    try:
        with pytest.raises(asyncio.CancelledError):
            asyncio.run(call())
        assert ended.wait(10.0)
    finally:
        leads[0].end()
    assert source.closed.is_set()
