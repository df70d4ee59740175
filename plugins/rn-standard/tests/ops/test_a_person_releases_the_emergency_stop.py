"""Who releases the emergency stop: a person, in a terminal or asked by the client, or clients if so
configured.
"""

from __future__ import annotations

import io
import json
import os
import pty
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TextIO

import anyio
import pytest
from mcp import Client, types

from rn_standard.ops.plugin import CLIENTS
from rn_testing.domain import free_ros_domain
from rn_testing.fakes import fake_registry
from roboneuron.cli.main import main
from roboneuron.config import parse_config
from roboneuron.estop import ESTOP_FILE, EmergencyStopLatch
from roboneuron.server.app import Application

pytestmark = pytest.mark.ros
MODES = ("auto", "legacy")


@pytest.fixture
def serve(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Application]]:
    """Return a function that makes an application, `more` being lines of [server]; the stop is
    latched.
    """
    monkeypatch.setenv("ROS_DOMAIN_ID", str(free_ros_domain()))
    made: list[Application] = []

    def make(more: str = "") -> Application:
        registry = fake_registry(CLIENTS)
        application = Application(
            parse_config(f'[robot]\nname = "gantry"\n[server]\n{more}'),
            plugins=lambda: registry,
            directory=tmp_path,
            command=lambda python: pytest.fail("nothing may be spawned"),
        )
        made.append(application)
        application.loop.emergency_stop.file.latch(who="a guard", reason="a hand in the workspace")
        return application

    yield make
    for application in made:
        application.close()


class Person:
    """Answers what the client asks."""

    def __init__(
        self,
        action: str,
        content: dict[str, Any] | None = None,
        then: Callable[[], object] = lambda: None,
    ):
        self.asked: list[str] = []
        self._answer = types.ElicitResult(action=action, content=content)  # type: ignore[arg-type]
        self._then = then

    async def __call__(self, context: Any, params: types.ElicitRequestParams) -> types.ElicitResult:
        self.asked.append(params.message)
        answer = self._answer
        self._then()
        return answer

    def refuse(self) -> None:
        """From the next question on."""
        self._answer = types.ElicitResult(action="decline")


def call(application: Application, mode: str, person: Person | None) -> types.CallToolResult:
    async def scenario() -> types.CallToolResult:
        async with Client(application.server, mode=mode, elicitation_callback=person) as client:  # type: ignore[arg-type]
            return await client.call_tool("reset_emergency_stop", {})

    return anyio.run(scenario)


def refusal(answer: types.CallToolResult) -> str:
    assert answer.is_error, answer.structured_content
    assert answer.meta is not None
    assert answer.meta["roboneuron/error"]["code"] == "refused"
    return answer.content[0].text  # type: ignore[union-attr]


@pytest.mark.parametrize("mode", MODES)
def test_a_client_that_cannot_ask_is_told_what_a_person_has_to_do(
    serve: Callable[..., Application], tmp_path: Path, mode: str
) -> None:
    application = serve()
    text = refusal(call(application, mode, None))
    assert "cannot ask one" in text
    assert f"roboneuron estop --reset --state {tmp_path}" in text
    assert application.loop.emergency_stop.is_latched()


@pytest.mark.parametrize("mode", MODES)
def test_a_person_who_agrees_releases_it(
    serve: Callable[..., Application], tmp_path: Path, mode: str
) -> None:
    application, person = serve(), Person("accept", {"confirmed": True})
    answer = call(application, mode, person)
    assert not answer.is_error, answer.content
    assert len(person.asked) == 1
    assert 'a guard: "a hand in the workspace"' in person.asked[0]
    assert not application.loop.emergency_stop.is_latched()
    records = [json.loads(line) for line in (tmp_path / "audit.jsonl").read_text().splitlines()]
    assert records[-1]["who"].startswith("a person asked by ")


@pytest.mark.sampled(every=2)  # the other protocol
@pytest.mark.parametrize(
    ("action", "content"),
    [
        ("decline", None),
        ("cancel", None),
        ("accept", {"confirmed": False}),
        ("accept", {}),
        ("accept", None),
    ],
)
@pytest.mark.parametrize("mode", MODES)
def test_any_other_answer_keeps_it_latched(
    serve: Callable[..., Application], mode: str, action: str, content: dict[str, Any] | None
) -> None:
    application, person = serve(), Person(action, content)
    assert call(application, mode, person).is_error
    assert len(person.asked) == 1
    assert application.loop.emergency_stop.is_latched()


@pytest.mark.parametrize("mode", MODES)
def test_a_stop_that_is_pressed_while_the_person_thinks_is_not_released(
    serve: Callable[..., Application], tmp_path: Path, mode: str
) -> None:
    application = serve()
    latch = application.loop.emergency_stop.file

    def press_again() -> None:
        if latch.read_state().who == "a guard":
            latch.reset(who="somebody", role="admin", audit=application.loop.emergency_stop.audit)
            latch.latch(who="another guard", reason="another hand")
            person.refuse()

    person = Person("accept", {"confirmed": True}, then=press_again)
    answer = call(application, mode, person)
    assert answer.is_error
    assert len(person.asked) == (2 if mode == "auto" else 1), (
        "the new protocol asks about the new stop"
    )
    assert "another guard" in person.asked[-1] or mode == "legacy"
    assert application.loop.emergency_stop.is_latched()
    assert latch.read_state().who == "another guard"


def test_an_answer_to_a_question_that_was_not_asked_counts_for_nothing(
    serve: Callable[..., Application],
) -> None:
    application, person = serve(), Person("decline")

    async def scenario() -> types.CallToolResult:
        async with Client(application.server, elicitation_callback=person) as client:  # type: ignore[arg-type]
            yes = types.ElicitResult(action="accept", content={"confirmed": True})
            return await client.call_tool(
                "reset_emergency_stop",
                {},
                input_responses={"confirm": yes},
                request_state="made-up",
            )

    assert anyio.run(scenario).is_error
    assert len(person.asked) == 1
    assert application.loop.emergency_stop.is_latched()


@pytest.mark.parametrize("mode", MODES)
def test_a_stop_that_is_pressed_during_a_release_of_none_is_kept(
    serve: Callable[..., Application], monkeypatch: pytest.MonkeyPatch, mode: str
) -> None:
    """Nobody was asked about it: nothing was latched when the call looked."""
    application, person = serve(), Person("accept", {"confirmed": True})
    stop = application.loop.emergency_stop
    stop.file.reset(who="somebody", role="admin", audit=stop.audit)
    is_latched = stop.is_latched

    def look_then_press() -> bool:
        found = is_latched()
        stop.file.press(who="another guard", reason="another hand")
        return found

    monkeypatch.setattr(stop, "is_latched", look_then_press)
    answer = call(application, mode, person)
    assert (person.asked, answer.is_error) == ([], False)
    assert "not latched" in str(answer.structured_content)
    assert stop.file.read_state().who == "another guard"


@pytest.mark.parametrize("mode", MODES)
def test_the_configuration_may_leave_it_to_clients(
    serve: Callable[..., Application], mode: str
) -> None:
    application = serve('reset_emergency_stop = "client"')
    answer = call(application, mode, None)
    assert not answer.is_error, answer.content
    assert not application.loop.emergency_stop.is_latched()


def run_estop(state: Path, typed: str | None) -> int:
    """`roboneuron estop --reset` in a terminal in which somebody types; without one when `typed` is
    None.
    """
    words = ["estop", "--reset", "--state", str(state)]
    if typed is None:
        return answered(io.StringIO("y\n"), words)
    person, terminal = pty.openpty()
    try:
        os.write(person, typed.encode())
        with os.fdopen(terminal) as stdin:
            return answered(stdin, words)
    finally:
        os.close(person)


def answered(stdin: TextIO, words: list[str]) -> int:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "stdin", stdin)
        return main(words)


@pytest.mark.parametrize(
    ("typed", "code", "says", "stays"),
    [
        ("y\n", 0, "Released.", False),
        ("\n", 1, "It stays latched.", True),
        ("n\n", 1, "It stays latched.", True),
        ("\x04", 1, "It stays latched.", True),
        (None, 1, "in a terminal", True),
    ],
)
def test_the_command_line_releases_it_for_a_person_in_a_terminal(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    typed: str | None,
    code: int,
    says: str,
    stays: bool,
) -> None:
    latch = EmergencyStopLatch(tmp_path / ESTOP_FILE, lambda: 1)
    latch.latch(who="a guard", reason="smoke")
    assert (run_estop(tmp_path, typed) != 0) == (code != 0)
    assert says in "".join(capsys.readouterr())
    assert latch.is_latched() is stays
    assert stays is False or "smoke" in latch.read_state().reason
