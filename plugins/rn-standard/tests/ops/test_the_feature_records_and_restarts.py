"""What an agent reads of a server with this feature: incidents, logs, restarts; and the server's
log as a file.
"""

from __future__ import annotations

import json
import logging
import os
import signal
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import anyio
import pytest
from mcp import Client

from rn_standard.ops.feature import SafetyFaults
from rn_standard.ops.incidents import KEPT
from rn_standard.ops.plugin import FEATURE
from rn_testing.agent import Agent, client_of
from rn_testing.waiting import wait_until
from roboneuron.feature import ModuleView, Report
from roboneuron.server.app import Application

SOURCES = ("robot", "perception", "inference", "control", "server")


@pytest.fixture
def application(application_of: Callable[..., Application]) -> Application:
    return application_of(FEATURE)


def ask(application: Application, name: str, **arguments: Any) -> dict[str, Any]:
    async def call() -> dict[str, Any]:
        async with Client(application.server) as client:
            answer = await client.call_tool(name, arguments)
            assert not answer.is_error, answer.content
            return dict(answer.structured_content or {})

    return anyio.run(call)


def test_the_tools_and_the_logs_of_modules_and_server_are_offered(application: Application) -> None:
    path = application.supervisor.log_directory / "server.log"
    path.parent.mkdir(parents=True)
    path.write_text("first\nsecond\n")
    (application.supervisor.log_directory / "robot.log").write_text("third\n")

    async def look() -> None:
        async with Client(application.server) as client:
            assert {"get_logs", "list_incidents"} <= application.tools.names()
            uris = [str(resource.uri) for resource in (await client.list_resources()).resources]
            assert uris == [
                "roboneuron://status",
                *(f"roboneuron://logs/{source}" for source in SOURCES),
            ]
            text = (await client.read_resource("roboneuron://logs/server")).contents[0]
            assert text.text == "first\nsecond"  # type: ignore[union-attr]
            text = (await client.read_resource("roboneuron://logs/robot")).contents[0]
            assert text.text == "third"  # type: ignore[union-attr]
            with pytest.raises(Exception, match=r"no resource 'roboneuron://logs/\.\./secret'"):
                await client.read_resource("roboneuron://logs/../secret")

    anyio.run(look)


def test_faults_that_others_tell_are_recorded(application: Application) -> None:
    application.events.fault.tell("inference", "lease", {"explanation": "ann's lease has lapsed"})
    (incident,) = ask(application, "list_incidents")["incidents"]
    assert (incident["module"], incident["what"]) == ("inference", "lease")
    assert incident["explanation"] == "ann's lease has lapsed"


def test_a_latch_that_vanishes_is_an_incident_and_each_time_a_fault(
    application: Application,
) -> None:
    times: list[int] = []
    application.events.fault.listen(lambda where, what, facts: times.append(facts["times"]))
    application.features.start(application.host)
    stop = application.loop.emergency_stop
    stop.file.press(who="ann", reason="smoke")
    for _ in range(2):
        stop.file.path.unlink()
        stop.follow_file()  # as the server does every 30 ms
        wait_until(lambda: times[-1:] == [stop.file.read_state().restored], 5.0, "it is told")
    assert times == [1, 2]
    (incident,) = ask(application, "list_incidents")["incidents"]
    assert (incident["module"], incident["what"]) == ("emergency_stop", "latch_vanished")
    assert stop.audit.path.read_text().count('"restored"') == 2


def test_requests_of_foreign_nodes_are_incidents(
    application: Application, monkeypatch: pytest.MonkeyPatch
) -> None:
    def seen(count: int) -> list[ModuleView]:
        report = Report(
            dropped_by={"foreign_request": count}, metrics={"foreign_request": "by /meddler"}
        )
        return [ModuleView(kind="robot", phase="running", report=report)]

    told: list[tuple[str, str, Mapping[str, Any]]] = []
    faults = SafetyFaults(application.loop, lambda *fault: told.append(fault))
    for count in (0, 2, 2, 0, 1):  # at the end a process that was started again
        monkeypatch.setattr(application.loop.modules, "views", lambda count=count: seen(count))
        faults.look()
    assert [facts["count"] for _, _, facts in told] == [2, 1]
    assert told[0][:2] == ("robot", "foreign_request")
    assert told[0][2]["explanation"] == "by /meddler"


def fault(number: int) -> dict[str, Any]:
    """Of the size that real ones have."""
    status = {
        "health": "exited",
        "error": {"message": f"fault {number}"},
        "note": "",
        "exit": None,
        "published": 9,
    }
    return {
        "explanation": "its process ended by itself",
        "status": status,
        "log": [f"2026-01-01 00:00:00,000 INFO x: line {i} {'y' * 300}" for i in range(40)],
        "actions": [{"sent_ns": i, "values": [0.1] * 7} for i in range(30)],
    }


def test_incidents_are_a_line_each_and_one_of_them_is_told_in_full(
    application: Application,
) -> None:
    kinds = ("robot", "perception", "inference", "control")
    for number, kind in enumerate(kinds):
        application.events.fault.tell(kind, "exited", fault(number))
    listed = ask(application, "list_incidents", entries=3)
    told = {key: value for key, value in listed.items() if key != "directory"}
    assert len(json.dumps(told)) < 2000, "it was 22 kB"
    assert [i["module"] for i in listed["incidents"]] == ["control", "inference", "perception"]
    assert listed["more"] == 1
    assert listed["incidents"][0]["explanation"] == "its process ended by itself: fault 3"
    (whole,) = ask(application, "list_incidents", id=listed["incidents"][0]["id"])["incidents"]
    assert whole["status"] == {"health": "exited", "error": {"message": "fault 3"}, "published": 9}
    assert len(whole["actions"]) == 30
    assert "older lines are left out" in whole["log"][0]
    assert "line 39" in whole["log"][-1]
    assert sum(map(len, whole["log"])) < 9000


@pytest.mark.parametrize(("count", "is_cut"), [(KEPT - 1, False), (KEPT + 1, True)])
def test_counts_say_since_when_records_are_kept(
    application: Application, count: int, is_cut: bool
) -> None:
    for number in range(count):
        application.events.fault.tell("robot", f"fault_{number}", {"explanation": ""})
    listed = ask(application, "list_incidents", entries=100)
    assert bool(listed.get("since")) == is_cut
    assert len(listed["kinds"]) == min(count, KEPT)


def test_an_incident_that_there_is_not_is_refused(application: Application) -> None:
    async def call() -> Any:
        async with Client(application.server) as client:
            return await client.call_tool("list_incidents", {"id": "nothing"})

    answer = anyio.run(call)
    assert answer.is_error
    assert (
        answer.content[0].text
        == "There is no incident 'nothing'. Call list_incidents without `id`."
    )


def test_logs_are_bounded_and_say_what_is_left_out(application: Application) -> None:
    path = application.supervisor.log_directory / "server.log"
    path.parent.mkdir(parents=True)
    path.write_text(
        "".join(f"2026-01-01 00:00:00,000 INFO x: {i} {'y' * 2000}\n" for i in range(300))
    )
    answer = ask(application, "get_logs", module="server", entries=500)
    assert len(json.dumps(answer)) < 25_000
    assert answer["more"] > 0
    assert answer["entries"][-1]["text"].startswith("299 ")
    assert len(application.resources["roboneuron://logs/server"].read()) < 45_000


def test_the_log_begins_before_ros_is_joined_and_goes_on_until_all_is_closed(
    application: Application,
) -> None:
    log = logging.getLogger("tests")
    application.events.open.tell()
    log.info("the server begins")
    application.features.close()
    log.info("the modules are ended")
    application.close()
    log.info("after the end")
    text = (application.supervisor.log_directory / "server.log").read_text()
    assert "the server begins" in text
    assert "the modules are ended" in text
    assert "after the end" not in text


@pytest.mark.ros
@pytest.mark.timeout(240)
def test_faults_are_recorded_and_perception_is_restarted(
    config_text: str, server_environment: dict[str, str], tmp_path: Path
) -> None:
    path = tmp_path / "roboneuron.toml"
    path.write_text(f"{config_text}[ops]\nrestart_backoff_s = 0.2\n")

    async def scenario() -> None:
        async with client_of(path, server_environment, "--log-level", "warning") as client:
            do = Agent(client).do

            async def module(kind: str) -> dict[str, Any]:
                return next(m for m in (await do("get_status"))["modules"] if m["module"] == kind)

            async def until(kind: str, *words: str) -> None:
                with anyio.fail_after(60):
                    while (await module(kind))["health"] not in words:
                        await anyio.sleep(0.05)

            async def recorded(wanted: set[tuple[str, str]]) -> list[dict[str, Any]]:
                with anyio.fail_after(60):
                    while True:
                        found: list[dict[str, Any]] = (await do("list_incidents", entries=100))[
                            "incidents"
                        ]
                        if wanted <= {(i["module"], i["what"]) for i in found}:
                            return found
                        await anyio.sleep(0.05)

            for kind in ("robot", "perception", "control"):
                await do(f"start_{kind}")
            await do("start_inference", instruction="move on")
            await until("inference", "ok")
            # incidents tell the last actions, and the stop of control's freeze ends them
            with anyio.fail_after(60):
                while (await module("inference"))["published"] < 10:
                    await anyio.sleep(0.05)

            control = (await module("control"))["pid"]
            os.kill(control, signal.SIGSTOP)
            await until("control", "silent")
            # the server looks at its modules by itself, a little later
            await recorded({("control", "silent")})
            os.kill(control, signal.SIGCONT)
            await until("control", "ok")

            perception = (await module("perception"))["pid"]
            os.kill(perception, signal.SIGKILL)
            with anyio.fail_after(60):
                while not (now := await module("perception"))["ready"] or now["pid"] == perception:
                    await anyio.sleep(0.05)
            await until("inference", "ok")

            found = await recorded(
                {("control", "silent"), ("perception", "exited"), ("perception", "restart")}
            )
            line = next(i for i in found if (i["module"], i["what"]) == ("perception", "exited"))
            assert line.keys() == {"id", "at", "module", "what", "explanation"}
            (exited,) = (await do("list_incidents", id=line["id"]))["incidents"]
            assert exited["status"]["exit"]["code"] == -9
            assert len(exited["actions"]) > 2
            assert len(exited["actions"][-1]["values"]) == 7
            only = (await do("list_incidents", module="control", entries=1))["incidents"]
            assert [i["module"] for i in only] == ["control"]

            own = await do("get_logs", module="server", contains="Spawned inference")
            assert [(e["level"], e["logger"]) for e in own["entries"]] == [
                ("info", "roboneuron.supervisor.supervisor")
            ]
            logs = await do("get_logs", module="inference", entries=3)
            assert len(logs["entries"]) <= 3
            assert Path(logs["path"]).exists()

    anyio.run(scenario)
