"""A server with real modules and a real recorder: what is in the file, and what the robot notices
of its end.
"""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import anyio
import pytest

from rn_recorder_runs.files import is_finished, read_attachments, read_records
from rn_recorder_runs.reading import count_topics, iterate
from rn_recorder_runs.store import RunStore
from rn_testing.agent import Agent, client_of


def recorder_pid(parent: int) -> int | None:
    """The recorder among a server's children."""
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            command = (entry / "cmdline").read_bytes()
            status = (entry / "stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if b"rn_recorder_runs.node" in command and int(status[1]) == parent:
            return int(entry.name)
    return None


def child_of_this_process() -> int:
    """The server that the client started: the only child that serves."""
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            command = (entry / "cmdline").read_bytes()
            status = (entry / "stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if b"roboneuron.cli.main" in command and int(status[1]) == os.getpid():
            return int(entry.name)
    raise AssertionError("no server")


@pytest.mark.ros
@pytest.mark.timing
@pytest.mark.timeout(240)
def test_a_recorder_that_stalls_dies_or_loses_its_server_leaves_readable_files(
    config_path: Path, server_environment: dict[str, str], tmp_path: Path
) -> None:
    store = RunStore(tmp_path / "state" / "runs")

    async def scenario() -> None:
        async with client_of(config_path, server_environment, "--log-level", "warning") as client:
            do = Agent(client).do

            async def until(condition: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
                with anyio.fail_after(60):
                    while not condition(now := await do("list_recordings")):
                        await anyio.sleep(0.05)
                return now

            await until(lambda now: now["recorder"] == "ok")
            run = (await do("start_recording", name="first"))["id"]
            for kind in ("robot", "perception", "control"):
                await do(f"start_{kind}")
            await do("start_inference", instruction="move on")
            await anyio.sleep(3.0)
            stopped = await do("stop_recording", outcome="success")
            assert stopped["id"] == run

            second = (await do("start_recording", name="second"))["id"]
            await anyio.sleep(1.5)
            parent = child_of_this_process()
            recorder = recorder_pid(parent)
            assert recorder is not None
            assert os.getpriority(os.PRIO_PROCESS, recorder) > os.getpriority(
                os.PRIO_PROCESS, parent
            )

            async def pids() -> dict[str, Any]:
                modules = (await do("get_status"))["modules"]
                # health would measure the machine's load
                return {m["module"]: m.get("pid") for m in modules}

            before = await pids()
            os.kill(recorder, signal.SIGSTOP)
            await anyio.sleep(2.0)
            assert await pids() == before
            os.kill(recorder, signal.SIGKILL)
            await until(lambda now: now["restarts"] == 1 and now["recording"] == second)
            assert await pids() == before
            await anyio.sleep(1.5)

            perception = next(
                m["pid"] for m in (await do("get_status"))["modules"] if m["module"] == "perception"
            )
            os.kill(perception, signal.SIGKILL)
            await until(lambda now: any(run["kind"] == "incident" for run in now["runs"]))
            interrupted.append(second)
            os.kill(parent, signal.SIGKILL)

    interrupted: list[str] = []
    try:
        anyio.run(scenario)
    except Exception:
        if not interrupted:  # afterwards it is the client's own end: its server was killed
            raise

    async def settled() -> None:
        with anyio.fail_after(30):
            while store.is_in_use():
                await anyio.sleep(0.1)

    anyio.run(settled)
    store.repair()
    runs = {run.id: run for run in store.runs()}
    assert all(is_finished(path) for run in runs.values() for path in run.files)
    first = next(run for run in runs.values() if run.id.endswith("-first"))
    topics = count_topics(first.files)
    by_name = {topic.rpartition("/")[2]: counts for topic, counts in topics.items()}
    assert {
        "image",
        "action",
        "joint_states",
        "ee_pose",
        "predictions",
        "events",
        "diagnostics",
    } <= set(by_name)
    for name in ("action", "joint_states", "predictions"):
        assert by_name[name].lost == 0, (name, by_name[name])
    events = [
        json.loads(found.message.data)
        for found in iterate(first.files, lambda t: t == "/roboneuron/events")
    ]
    assert "start_inference" in [event["tool"] for event in events if event["what"] == "call"]
    started = [
        event["names"]
        for event in events
        if event["what"] == "change" and event["phase"] == "running"
    ]
    assert "instant" in [names.get("backend") for names in started]
    seen = [
        json.loads(found.message.data)
        for found in iterate(first.files, lambda t: t.endswith("/predictions"))
    ]
    assert {prediction["instruction"] for prediction in seen} == {"move on"}
    actions = [
        found.message for found in iterate(first.files, lambda topic: topic.endswith("/action"))
    ]
    assert len(actions) > 5
    assert all(len(action.data) == 7 for action in actions)
    assert first.facts["outcome"] == "success"
    incidents = [run for run in runs.values() if run.kind == "incident"]
    told = [
        fact
        for run in incidents
        for fact in json.loads(read_attachments(run.files[0])["incident.json"])
    ]
    assert "server_ended" in [fact["what"] for fact in told]
    assert ("perception", "exited") in [
        (fact.get("module"), fact.get("health")) for fact in told
    ], told
    for incident in incidents:
        assert "incident.json" in read_attachments(incident.files[0])
        assert any(True for _ in read_records(incident.files[0]))
    later = next(run for run in runs.values() if run.id.endswith("-second"))
    assert len(later.files) >= 2
    assert later.facts["state"] == "interrupted"
    assert [later.id] == interrupted
