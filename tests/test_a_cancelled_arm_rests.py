"""The simulated FR3 is at rest soon after the call that moves it is cancelled, and what was being
started is not there: every call, way, transport and protocol.

Judged by its measured joints, by the truth of the simulation.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, get_args

import pytest
from cancel_table import Table, printed
from cancel_wire import (
    HTTP_WAYS,
    LAST_WAYS,
    STDIO_WAYS,
    HttpClient,
    StdioClient,
    Way,
    check_cell,
)
from cancelled_arm import CALLS, INSTRUCTION, MOTIONS, SIMULATED, STARTS, SWITCHES, Arm
from mcp_types.version import KNOWN_PROTOCOL_VERSIONS

from rn_testing.waiting import holds_within, wait_until
from roboneuron.ros.environment import prepare_environment

pytestmark = [pytest.mark.ros, pytest.mark.timeout(300)]
NEWEST = "2026-07-28"
WHOLE = ("2025-11-25", NEWEST)
"""Protocols with and without sessions, for which every call is tried."""
FEW = ("move_joints", "move_ee", "run_task")
QUICK = ("move_joints", "run_task", "set_instruction")
"""Cancelled by a notification of the newest protocol over HTTP in the default suite."""
REST_S = 3.0
"""Deceleration, the window in which rest is measured, and a busy machine."""
START_S = 60.0
QUIET_S = 1.0


def why_not(transport: str, version: str, way: str, call: str) -> str:
    """Why there is no such cell; empty if there is one."""
    if way == "session deleted" and version == NEWEST:
        return "this protocol has no sessions"
    if way in ("id as text", "wrong id") and call not in ("move_joints", "run_task"):
        return "ids are compared alike for all calls"
    if transport == "stdio" and way in LAST_WAYS and call not in FEW:
        return "everything is stopped, as for the others"
    if version not in WHOLE and call not in FEW:
        return "as under 2025-11-25: the protocols with sessions share the code"
    if call == "play_recording" and (transport == "stdio" or way not in _PLAYED):
        return "as move_joints; it needs a server of its own, which serves replays only"
    return ""


_PLAYED: tuple[Way, ...] = ("notification", "stream closed")


def cells() -> Iterator[Any]:
    """Transport, protocol, way, call. Recordings are played last: they need another server."""
    for plays in (False, True):
        for transport, ways in (("http", HTTP_WAYS), ("stdio", STDIO_WAYS)):
            for version in KNOWN_PROTOCOL_VERSIONS:
                for way in ways:
                    for call in CALLS:
                        row = (transport, version, way, call)
                        if (call == "play_recording") is not plays or why_not(*row):
                            continue
                        is_quick = row[:3] == ("http", NEWEST, "notification") and call in QUICK
                        marks = () if is_quick else (pytest.mark.slow, pytest.mark.timeout(300))
                        yield pytest.param(*row, id="-".join(row).replace(" ", "_"), marks=marks)


@pytest.fixture(scope="module")
def table() -> Iterator[Table]:
    with printed(Table(CALLS), why_not) as made:
        yield made


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Arm]:
    folder = tmp_path_factory.mktemp("arm")
    prepare_environment(folder / "ros")
    made = Arm(folder)
    yield made
    made.close()


@pytest.mark.parametrize(("transport", "version", "way", "call"), list(cells()))
def test_an_arm_rests_after_its_call_is_cancelled(
    arm: Arm, table: Table, transport: str, version: str, way: Way, call: str
) -> None:
    with table.cell(transport, version, way, call) as tell:
        client = arm.use(transport, version, way, call)
        arm.prepare(call)
        if call in MOTIONS:
            tell(check_cell(client, way, next(MOTIONS[call]), arm.moves, arm.rests, REST_S))
        elif call == "play_recording":
            motion = ("play_recording", {"files": arm.files})
            tell(check_cell(client, way, motion, arm.moves, arm.rests, REST_S))
        else:
            tell(_CHECKS.get(call, check_switch if call in SWITCHES else check_start)(
                arm, client, way, call
            ))  # fmt: skip
            client.leave_call()


def continues(client: HttpClient | StdioClient, way: Way) -> bool:
    """True if this way is no cancellation in the protocol, for a call that moves nothing itself:
    it continues for a client that may come back for its answer.
    """
    return way in ("stream closed", "client killed") and client.version != NEWEST


def check_start(arm: Arm, client: HttpClient | StdioClient, way: Way, call: str) -> str:
    """A start that is cancelled starts nothing, and nothing moves."""
    kind = "inference" if call == "start_all" else call.removeprefix("start_")
    kinds = ("robot", "perception", "control", kind) if call == "start_all" else (kind,)
    client.begin(call, STARTS[call])
    wait_until(lambda: arm.phase(kinds[0]) != "stopped", START_S, "the start begins")
    client.cancel(way)
    if continues(client, way):
        wait_until(lambda: arm.phase(kind) == "running", START_S, "the start continues")
        return "continues"
    wait_until(
        lambda: all(arm.phase(one) == "stopped" for one in kinds), START_S, "the start has ended"
    )
    assert not holds_within(arm.moves, QUIET_S), "a cancelled start moves the arm"
    return "not started"


def check_switch(arm: Arm, client: HttpClient | StdioClient, way: Way, call: str) -> str:
    """A switch that is cancelled replaces nothing, and nothing moves."""
    kind = call.removeprefix("switch_")
    before = arm.module(kind)["started_at"]
    client.begin(call, {})
    wait_until(client.has_progress, START_S, "the switch begins")
    client.cancel(way)
    if continues(client, way):
        wait_until(lambda: arm.module(kind)["started_at"] != before, START_S, "it is replaced")
        return "continues"
    assert not holds_within(lambda: arm.module(kind)["started_at"] != before, 3 * QUIET_S)
    assert arm.phase(kind) == "running"
    assert not arm.moves()
    return "old one stays"


def check_instruction(arm: Arm, client: HttpClient | StdioClient, way: Way, call: str) -> str:
    """An instruction whose call is cancelled before its first action is withdrawn."""
    client.begin(call, {"instruction": INSTRUCTION})
    client.cancel(way)
    moved = holds_within(arm.moves, 5.0)
    if continues(client, way) or client.has_succeeded():
        assert moved, "an instruction that was answered moves nothing"
        outcome = "answered" if client.has_succeeded() else "continues"
    else:
        wait_until(lambda: not arm.module("inference")["instruction"], START_S, "it is withdrawn")
        wait_until(arm.rests, REST_S, "rest")
        assert not holds_within(arm.moves, QUIET_S), "it moves again"
        outcome = "withdrawn"
    arm.steward.call("stop_inference", {})
    return outcome


def check_lead(arm: Arm, client: HttpClient | StdioClient, way: Way, call: str) -> str:
    """A lead ends if its call is cancelled before it is answered; the person pushes on."""
    arm.push(True)
    try:
        client.begin(call, {"source": "twist-topic"})
        client.cancel(way)
        if client.has_answered() or continues(client, way):
            assert holds_within(arm.moves, 5.0), "an answered lead moves nothing"
            arm.steward.call("hand_back", {})
            return "answered" if client.has_answered() else "continues"
        assert not holds_within(lambda: not arm.rests(), 0.0) or holds_within(arm.rests, REST_S)
        assert not holds_within(arm.moves, QUIET_S), "a cancelled lead moves the arm"
        return "nobody leads"
    finally:
        arm.push(False)


def check_simulate(arm: Arm, client: HttpClient | StdioClient, way: Way, call: str) -> str:
    """A cancelled simulation moves nothing, as does a simulation; the next one is answered."""
    tool, arguments = SIMULATED[call]
    client.begin(tool, {**arguments, "simulate": True})
    client.cancel(way)
    assert not holds_within(arm.moves, QUIET_S), "a simulation moves the arm"
    tool, arguments = SIMULATED["sim. joints"]
    assert arm.steward.call(tool, {**arguments, "simulate": True})["simulated"]
    return "moves nothing"


def check_recording(arm: Arm, client: HttpClient | StdioClient, way: Way, call: str) -> str:
    """A recording whose start is cancelled is not made; one that was answered goes on."""
    client.begin(call, {"duration_s": 60})
    client.cancel(way)
    has_answered = client.has_answered()
    is_made = holds_within(
        lambda: bool(arm.steward.call("list_recordings", {})["recording"]), QUIET_S
    )
    if is_made:
        arm.steward.call("stop_recording", {})
    assert is_made is (has_answered or continues(client, way))
    assert not arm.moves()
    return "continues" if is_made else "not made"


_CHECKS: dict[str, Callable[[Arm, Any, Way, str], str]] = {
    "set_instruction": check_instruction,
    "lead_arm": check_lead,
    **dict.fromkeys(SIMULATED, check_simulate),
    "start_recording": check_recording,
}
assert set(HTTP_WAYS) | set(STDIO_WAYS) == set(get_args(Way))
