"""The tool recover_robot: who may call it, when it is refused, what it answers and what the audit
keeps.

The robot module is a process of its own with a driver that plays an arm with a fault.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import anyio
import pytest
from mcp import Client, types

from rn_standard.ops.plugin import CLIENTS, RECOVERY
from rn_testing.domain import free_ros_domain
from rn_testing.fakes import fake_plan, fake_registry
from rn_testing.fakes.site import PluginSite
from roboneuron import DriverSpec, RobotSpec
from roboneuron.config import parse_config
from roboneuron.server.app import Application

PLUGIN = """
import os
from pathlib import Path

from rn_testing.fakes.robot import FakeDriver
from roboneuron import RefusedError, StateError

FAULT = Path(os.environ["FAULT_FOR_TESTS"])

class Faulty(FakeDriver):
    def recover(self):
        fault = FAULT.read_text()
        if not fault:
            raise StateError("The arm has no fault to recover from.")
        if fault == "pressed":
            raise RefusedError("The user stop is pressed.", hint="Release it.")
        if fault == "broken":
            raise RuntimeError("the client library broke")
        FAULT.write_text("")
        return fault

SPEC = RobotSpec(name="arm", summary="Has faults.", target="rn_testing.fakes.robot:gantry_profile",
                 drivers=(DriverSpec(name="faulty", summary="Has faults.", target="rn_faulty_plugin:Faulty",
                                     recovers=True),
                          DriverSpec(name="sound", summary="Has none.", target="rn_testing.fakes.robot:FakeDriver")))

@hookimpl
def roboneuron_robots():
    return [SPEC]
"""  # noqa: E501


DRIVERS = tuple(
    DriverSpec(name=name, summary="For tests.", target="rn_faulty_plugin:Faulty", recovers=recovers)
    for name, recovers in (("faulty", True), ("sound", False))
)
ARM = RobotSpec(
    name="arm",
    summary="Has faults.",
    target="rn_testing.fakes.robot:gantry_profile",
    drivers=DRIVERS,
)


@dataclass(kw_only=True)
class Served:
    """A server with a running robot.

    Attributes:
        fault: what ails the arm: a code, "pressed" as long as the user stop is, "broken", or
            nothing.
        audit: where the server writes.
    """

    application: Application
    fault: Path
    audit: Path

    def ask(self, answer: str | None) -> types.CallToolResult:
        """Call the tool as a client whose person accepts or declines; None: a client that cannot
        ask.
        """

        async def person(context: Any, params: types.ElicitRequestParams) -> types.ElicitResult:
            assert "Look at the arm" in params.message
            content = {"confirmed": True} if answer == "accept" else None
            return types.ElicitResult(action=answer, content=content)  # type: ignore[arg-type]

        async def scenario() -> types.CallToolResult:
            callback = None if answer is None else person
            async with Client(self.application.server, elicitation_callback=callback) as client:
                return await client.call_tool("recover_robot", {})

        return anyio.run(scenario)

    def records(self) -> list[dict[str, Any]]:
        """Of this tool, from the audit."""
        lines = self.audit.read_text().splitlines() if self.audit.exists() else []
        return [record for record in map(json.loads, lines) if record["tool"] == "recover_robot"]


def application(folder: Path, driver: str) -> Application:
    registry = fake_registry(ARM, CLIENTS, RECOVERY)
    config = parse_config(f'[robot]\nname = "arm"\ndriver = "{driver}"\n')
    return Application(config, plugins=lambda: registry, directory=folder)


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("recovery")
    site, fault = folder / "site", folder / "fault"
    PluginSite(path=site).install("rn-faulty", PLUGIN)
    fault.write_text("")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(site))
        patch.setenv("FAULT_FOR_TESTS", str(fault))
        patch.setenv("ROS_DOMAIN_ID", os.environ.get("ROS_DOMAIN_ID") or str(free_ros_domain()))
        made = application(folder / "state", "faulty")
        try:
            made.supervisor.start(fake_plan("robot", made.loop.config))
            yield Served(application=made, fault=fault, audit=folder / "state" / "audit.jsonl")
        finally:
            made.close()


def text(answer: types.CallToolResult) -> str:
    assert answer.is_error, answer.structured_content
    return answer.content[0].text  # type: ignore[union-attr]


def test_only_a_driver_that_has_faults_brings_the_tool(tmp_path: Path) -> None:
    made = application(tmp_path, "sound")
    try:
        assert "recover_robot" not in {tool.name for tool in made.tools.listing("admin")}
    finally:
        made.close()


@pytest.mark.ros
def test_a_person_recovers_it_once_and_the_audit_says_who(served: Served) -> None:
    served.fault.write_text("reflex")
    before = len(served.records())
    answer = served.ask("accept")
    assert not answer.is_error, answer.content
    assert answer.structured_content is not None
    assert answer.structured_content["recovered_from"] == "reflex"
    asked, done = served.records()[before:]
    assert [record["verdict"] for record in (asked, done)] == ["allowed", "allowed"]
    assert done["who"].startswith("a person asked by ")
    assert done["reason"] == "recovered reflex"
    assert "no fault" in text(served.ask("accept")), "there is nothing to recover a second time"


@pytest.mark.ros
def test_it_is_refused_while_the_cause_stands(served: Served) -> None:
    served.fault.write_text("pressed")
    assert "The user stop is pressed. Release it." in text(served.ask("accept"))
    assert served.fault.read_text() == "pressed"
    last = served.records()[-1]
    assert (last["verdict"], "pressed" in last["reason"]) == ("refused", True)


@pytest.mark.ros
def test_a_driver_that_breaks_is_an_answer_and_not_a_silence(served: Served) -> None:
    served.fault.write_text("broken")
    assert "RuntimeError: the client library broke" in text(served.ask("accept"))


@pytest.mark.ros
@pytest.mark.parametrize("answer", ["decline", "cancel", None])
def test_without_a_person_s_yes_nothing_is_asked_of_the_robot(
    served: Served, answer: str | None
) -> None:
    served.fault.write_text("reflex")
    before = len(served.records())
    assert "is not recovered" in text(served.ask(answer))
    assert served.fault.read_text() == "reflex"
    assert len(served.records()) == before


@pytest.mark.ros
@pytest.mark.parametrize("role", ["viewer", "", "Admin"])
def test_a_role_below_operator_is_refused_before_anything_happens(
    served: Served, role: str
) -> None:
    served.fault.write_text("reflex")
    context: Any = SimpleNamespace(who=role, role=role, simulated=False)
    answer = anyio.run(served.application.tools.call, "recover_robot", {}, context)
    assert "needs the role 'operator'" in text(answer)
    assert served.fault.read_text() == "reflex"


@pytest.mark.ros
def test_without_an_audit_nothing_is_recovered(served: Served) -> None:
    served.fault.write_text("reflex")
    served.audit.touch()
    kept = served.audit.with_suffix(".kept")
    served.audit.rename(kept)
    served.audit.mkdir()
    try:
        assert "audit" in text(served.ask("accept"))
        assert served.fault.read_text() == "reflex"
    finally:
        served.audit.rmdir()
        kept.rename(served.audit)
