"""Maintenance: nothing acts while a person has the robot, who and why are told, and it survives a
restart; the stop stays latched when the robot is put back.
"""

from __future__ import annotations

import json
import sys
from argparse import ArgumentParser
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import anyio
import pytest
from mcp import Client, types

from rn_standard.ops.maintenance import FILE_NAME, MaintenanceFeature, MaintenanceFile
from rn_standard.ops.maintenance_command import Maintenance
from rn_standard.ops.plugin import CLIENTS, MAINTENANCE
from rn_testing.domain import free_ros_domain
from rn_testing.fakes import fake_registry
from rn_testing.waiting import wait_until
from roboneuron.config import parse_config
from roboneuron.errors import RefusedError
from roboneuron.estop import EmergencyStopLatch
from roboneuron.gate.audit import AuditLog
from roboneuron.server.app import Application
from roboneuron.server.registry import ERROR_META

ACTS = ("start_robot", "set_instruction", "start_inference", "reset_emergency_stop")
Make = Callable[[], Application]


@pytest.fixture
def serve(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Make]:
    """Return a function that makes an application on one state directory."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(free_ros_domain()))
    made: list[Application] = []

    def make() -> Application:
        registry = fake_registry(CLIENTS, MAINTENANCE)
        application = Application(
            parse_config('[robot]\nname = "gantry"\n[server]\nreset_emergency_stop = "client"\n'),
            plugins=lambda: registry,
            directory=tmp_path,
            command=lambda python: pytest.fail("nothing may be spawned"),
        )
        made.append(application)
        return application

    yield make
    for application in made:
        application.close()


def feature_of(application: Application) -> MaintenanceFeature:
    return application.host.feature("maintenance", MaintenanceFeature)


def call(application: Application, tool: str, **arguments: Any) -> types.CallToolResult:
    async def scenario() -> types.CallToolResult:
        async with Client(application.server) as client:
            return await client.call_tool(tool, arguments)

    return anyio.run(scenario)


def rule_of(answer: types.CallToolResult) -> str:
    return str((answer.meta or {}).get(ERROR_META, {}).get("rule", ""))


@pytest.mark.ros
def test_nothing_acts_until_the_robot_is_back_and_the_stop_released(serve: Make) -> None:
    application = serve()
    maintenance = feature_of(application)
    maintenance.begin("ann", "operator", "changing the gripper")
    for tool in ACTS:
        arguments = {"instruction": "wave"} if tool == "set_instruction" else {}
        answer = call(application, tool, **arguments)
        assert answer.is_error, tool
        assert rule_of(answer) == "maintenance", tool
        assert "ann took the robot out of service" in str(answer.content)
        assert "changing the gripper" in str(answer.content)
    assert not call(application, "get_status").is_error
    assert not call(application, "emergency_stop").is_error

    again = serve()  # a restart
    assert rule_of(call(again, "start_robot")) == "maintenance"
    assert again.loop.emergency_stop.is_latched()
    with pytest.raises(RefusedError, match="needs the role 'admin'"):
        feature_of(again).end("ann", "operator")
    feature_of(again).end("bob", "admin")
    assert again.loop.emergency_stop.is_latched(), "back in service is no release of the stop"
    assert not call(again, "reset_emergency_stop").is_error


@pytest.mark.ros
def test_a_stop_that_is_released_meanwhile_is_latched_again(serve: Make, tmp_path: Path) -> None:
    application = serve()
    maintenance = feature_of(application)
    maintenance.start(application.host)
    try:
        maintenance.begin("ann", "admin", "")
        latch = EmergencyStopLatch.in_directory(tmp_path)
        latch.reset(who="bob", role="admin", audit=application.host.audit)
        wait_until(application.loop.emergency_stop.file.is_latched, 30.0)
        MaintenanceFile(tmp_path).end("bob", "admin", application.host.audit)  # in a terminal
        wait_until(lambda: maintenance.state is None, 30.0)
    finally:
        maintenance.close()


@pytest.mark.parametrize("role", ["viewer", ""])
def test_a_viewer_cannot_take_it_out_of_service(tmp_path: Path, role: str) -> None:
    audit = AuditLog.in_directory(tmp_path)
    with pytest.raises(RefusedError) as refused:
        MaintenanceFile(tmp_path).begin("eve", role, "fun", audit)
    assert refused.value.rule == "role"
    assert MaintenanceFile(tmp_path).read() is None


def test_the_first_person_stays_and_both_changes_are_in_the_audit(tmp_path: Path) -> None:
    file, audit = MaintenanceFile(tmp_path), AuditLog.in_directory(tmp_path)
    file.begin("ann", "operator", "bolts", audit)
    assert file.begin("bob", "operator", "nuts", audit).who == "ann"
    file.end("bob", "admin", audit)
    records = [json.loads(line) for line in audit.path.read_text().splitlines()]
    assert [(one["who"], one["tool"]) for one in records] == [
        ("ann", "begin_maintenance"),
        ("bob", "end_maintenance"),
    ]


@pytest.mark.parametrize(
    "text", ["", "{}", '{"who": 1', "[]", '{"who":"a","reason":"b","since_s":"x"}']
)
def test_a_file_that_cannot_be_read_counts_as_out_of_service(tmp_path: Path, text: str) -> None:
    (tmp_path / FILE_NAME).write_text(text)
    state = MaintenanceFile(tmp_path).read()
    assert state is not None
    assert "damaged" in str(state)


def run(*arguments: str) -> int:
    command = Maintenance()
    parser = ArgumentParser()
    command.configure(parser)
    return command.run(parser.parse_args(arguments))


def test_a_person_in_a_terminal_begins_and_ends_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    state = ("--state", str(tmp_path))
    assert run(*state) == 0
    assert run(*state, "--begin", "new cable") == 0
    assert EmergencyStopLatch.in_directory(tmp_path).is_latched()
    assert run(*state) == 1
    assert "new cable" in capsys.readouterr().out
    with pytest.raises(RefusedError, match="no terminal"):
        run(*state, "--end")
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(isatty=lambda: True))
    monkeypatch.setattr("builtins.input", lambda question: "n")
    assert run(*state, "--end") == 1
    monkeypatch.setattr("builtins.input", lambda question: "y")
    assert run(*state, "--end") == 0
    assert MaintenanceFile(tmp_path).read() is None
    assert EmergencyStopLatch.in_directory(tmp_path).is_latched()
