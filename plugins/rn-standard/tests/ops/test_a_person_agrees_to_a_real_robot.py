"""The first start of a real robot is asked of a person; a simulated one starts unasked."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import anyio
import pytest
from mcp import Client, types

from rn_standard.ops.plugin import CLIENTS, REAL_ROBOT
from rn_standard.tasks.plugin import FEATURE as TASKS
from rn_testing.fakes import fake_registry
from roboneuron import DriverSpec, RobotSpec
from roboneuron.config import parse_config
from roboneuron.errors import NotReadyError
from roboneuron.selection.plugin import FEATURE as SELECTION
from roboneuron.server.app import Application

MODES = ("auto", "legacy")
REACHED = "the robot would be spawned now"


def driver(name: str, *, simulated: bool) -> DriverSpec:
    return DriverSpec(
        name=name,
        summary="For tests.",
        target="rn_testing.fakes.robot:FakeDriver",
        simulated=simulated,
    )


ARM = RobotSpec(
    name="arm",
    summary="An arm.",
    target="rn_testing.fakes.robot:gantry_profile",
    drivers=(driver("network", simulated=False), driver("simulated", simulated=True)),
)


@pytest.fixture
def make(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Application]]:
    """Return a function that makes an application of a real arm, `more` being lines of the
    configuration.
    """
    made: list[Application] = []

    def refuse(*_: Any, **__: Any) -> None:
        raise NotReadyError(REACHED)

    def make(more: str = "") -> Application:
        registry = fake_registry(ARM, CLIENTS, REAL_ROBOT, SELECTION, TASKS)
        application = Application(
            parse_config(f'[robot]\nname = "arm"\ndriver = "network"\n{more}', registry=registry),
            plugins=lambda: registry,
            directory=tmp_path,
            command=lambda python: pytest.fail("nothing may be spawned"),
        )
        monkeypatch.setattr(application.loop, "start_selected", refuse)
        monkeypatch.setattr(application.loop.emergency_stop, "prepare", lambda namespace: None)
        application.events.open.tell()
        made.append(application)
        return application

    yield make
    for application in made:
        application.close()


class Person:
    """Answers what the client asks."""

    def __init__(self, agrees: bool) -> None:
        self.asked: list[str] = []
        self._agrees = agrees

    async def __call__(self, context: Any, params: types.ElicitRequestParams) -> types.ElicitResult:
        self.asked.append(params.message)
        return types.ElicitResult(
            action="accept" if self._agrees else "decline", content={"confirmed": self._agrees}
        )


def start(
    application: Application,
    person: Person | None,
    mode: str = "auto",
    tool: str = "start_robot",
    **arguments: Any,
) -> str:
    """The text of the answer to a call."""

    async def ask() -> types.CallToolResult:
        async with Client(application.server, mode=mode, elicitation_callback=person) as client:  # type: ignore[arg-type]
            return await client.call_tool(tool, arguments)

    return str(anyio.run(ask).content[0].text)  # type: ignore[union-attr]


def audited(folder: Path) -> list[tuple[str, str]]:
    lines = [json.loads(line) for line in (folder / "audit.jsonl").read_text().splitlines()]
    return [
        (line["verdict"], line["reason"])
        for line in lines
        if "first start" in line.get("reason", "")
    ]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("tool", ["start_robot", "start_all"])
def test_a_person_is_asked_once(
    make: Callable[..., Application], tool: str, mode: str, tmp_path: Path
) -> None:
    application, person = make(), Person(agrees=True)
    for _ in range(2):
        assert REACHED in start(application, person, mode, tool)
    assert len(person.asked) == 1
    assert person.asked[0].startswith(
        "Start the real robot arm (driver network)? It can move afterwards"
    )
    assert audited(tmp_path) == [
        ("allowed", "first start of the real robot by network: a person agreed")
    ]


@pytest.mark.parametrize("mode", MODES)
def test_nothing_is_started_when_the_person_does_not_agree(
    make: Callable[..., Application], mode: str
) -> None:
    application, person = make(), Person(agrees=False)
    for number in (1, 2):
        answer = start(application, person, mode)
        assert answer.startswith(
            "The real robot arm (driver network) is not started: a person did not agree."
        )
        assert len(person.asked) == number, "the next start is asked again"


@pytest.mark.parametrize(
    ("confirm", "expected"),
    [
        ("ask", REACHED),
        ("never", REACHED),
        ("require", "is not started: this client cannot ask a person."),
    ],
)
def test_a_client_that_cannot_ask_is_refused_where_that_is_required(
    make: Callable[..., Application], confirm: str, expected: str
) -> None:
    assert expected in start(make(f'[real_robot]\nconfirm = "{confirm}"\n'), None)


def test_a_simulated_robot_starts_unasked_and_a_real_driver_that_an_agent_names_does_not(
    make: Callable[..., Application],
) -> None:
    application, person = make('namespace = "cell"\n'), Person(agrees=False)
    assert REACHED in start(application, person, driver="simulated")
    assert person.asked == []
    assert "did not agree" in start(application, person, driver="network")


def test_nobody_is_asked_about_what_cannot_be_started(make: Callable[..., Application]) -> None:
    person = Person(agrees=True)
    assert "nonsense" in start(make(), person, driver="nonsense")
    assert person.asked == []


def test_the_description_says_so(make: Callable[..., Application]) -> None:
    tool = next(tool for tool in make().tools.listing() if tool.name == "start_robot")
    assert tool.description is not None
    assert "real robot arm (driver network)" in tool.description
    assert tool.description.endswith("A person is asked before the first start.")
