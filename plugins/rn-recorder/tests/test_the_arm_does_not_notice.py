"""A served arm goes on acting while its recorder meets a full disk, a read-only directory, or is
stopped and killed.

The directory of runs is a small disk of its own, in the server's mount namespace; it is read
through /proc.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import anyio
import pytest
from mcp import Client, StdioServerParameters
from test_a_server_is_recorded import recorder_pid

from rn_recorder_runs.files import is_finished, read_records
from rn_recorder_runs.store import RunStore

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(400)]
SIZE_MB = 24
MOST_S = 90.0


class Served:
    """A server with real modules that act, and its small disk."""

    def __init__(self, client: Client, disk: Path) -> None:
        self._client, self._disk = client, disk
        self.pid = 0
        self.pids: dict[str, int | None] = {}

    async def do(self, tool: str, /, **arguments: Any) -> dict[str, Any]:
        answer = await self._client.call_tool(tool, arguments)
        assert not answer.is_error, answer.content
        return dict(answer.structured_content or {})

    async def until(self, condition: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """What list_recordings says as soon as it is so."""
        with anyio.fail_after(MOST_S):
            while not condition(now := await self.do("list_recordings")):
                await anyio.sleep(0.05)
        return now

    async def start(self) -> None:
        await self.until(lambda now: now["recorder"] == "ok")
        for kind in ("robot", "perception", "control"):
            await self.do(f"start_{kind}")
        await self.do("start_inference", instruction="move on")
        self.pid = (await self.do("get_status"))["pid"]

    async def check_acts(self) -> None:
        """Control acts on further actions, and no process was replaced."""
        before = await self.modules()
        with anyio.fail_after(MOST_S):
            while (now := await self.modules())["control"]["published"] < before["control"][
                "published"
            ] + 20:
                await anyio.sleep(0.1)
        assert {kind: facts["pid"] for kind, facts in now.items()} == self.pids
        assert not any(facts["health"] in ("failing", "exited") for facts in now.values())

    async def modules(self) -> dict[str, dict[str, Any]]:
        found = {facts["module"]: facts for facts in (await self.do("get_status"))["modules"]}
        self.pids = self.pids or {kind: facts["pid"] for kind, facts in found.items()}
        return found

    @property
    def disk(self) -> Path:
        """The disk as this process can reach it."""
        return Path(f"/proc/{self.pid}/root{self._disk}")

    def inside(self, *command: str) -> None:
        """Run a program where the server is."""
        words = [
            "nsenter",
            "--target",
            str(self.pid),
            "--user",
            "--mount",
            "--preserve-credentials",
            *command,
        ]
        subprocess.run(words, check=True, timeout=30)


@pytest.fixture
def run_served(
    config_path: Path, server_environment: dict[str, str], tmp_path: Path
) -> Callable[..., list[Any]]:
    """Return a function that plays a scenario with a server, and gives the runs that were left."""
    disk, copy = tmp_path / "disk", tmp_path / "copy"
    disk.mkdir()
    with config_path.open("a") as file:
        file.write(f'min_free_mb = 0\ndirectory = "{disk}/runs"\n')

    def play(options: str, scenario: Callable[[Served], Awaitable[None]]) -> list[Any]:
        mount = f"mount -t tmpfs -o size={SIZE_MB}m,{options} none {disk}"
        if subprocess.run(
            ["unshare", "-rm", "sh", "-c", mount], capture_output=True, check=False
        ).returncode:
            pytest.skip("this machine lets nobody mount a small disk in a namespace")
        serve = (
            f'{mount} && exec {sys.executable} -m roboneuron.cli.main serve --config "$0" '
            "--log-level warning"
        )
        server = StdioServerParameters(
            command="unshare",
            args=["-rm", "sh", "-c", serve, str(config_path)],
            env=server_environment,
        )

        async def session() -> None:
            async with Client(server) as client:
                served = Served(client, disk)
                await scenario(served)
                shutil.copytree(served.disk / "runs" / "recordings", copy / "recordings")

        anyio.run(session)
        store = RunStore(copy)
        store.repair()
        runs = store.runs()
        assert runs
        for run in runs:
            assert all(
                is_finished(path) and any(True for _ in read_records(path)) for path in run.files
            )
        return runs

    return play


def test_a_full_disk(run_served: Callable[..., list[Any]]) -> None:
    async def scenario(served: Served) -> None:
        await served.start()
        run = (await served.do("start_recording", name="full"))["id"]
        await served.check_acts()
        filler = served.disk / "filler"
        with filler.open("wb", buffering=0) as file:
            while True:
                try:
                    file.write(bytes(4096))
                except OSError:
                    break
        await served.until(lambda now: "No space left" in now["problem"] and now["lost"] > 0)
        await served.check_acts()
        filler.unlink()
        await served.until(lambda now: not now["problem"] and now["recording"] == run)
        await served.check_acts()
        stopped = await served.do("stop_recording", outcome="success")
        assert stopped["lost"] > 0

    runs = run_served("rw", scenario)
    assert len(next(run for run in runs if run.kind == "recording").files) >= 2


def test_a_directory_that_may_not_be_written(run_served: Callable[..., list[Any]]) -> None:
    async def scenario(served: Served) -> None:
        await served.start()
        told = await served.until(lambda now: bool(now["problem"]))
        assert "Read-only" in told["problem"]
        await served.check_acts()
        served.inside("mount", "-o", "remount,rw", str(served._disk))
        await served.until(lambda now: not now["problem"])
        await served.do("start_recording", name="later")
        await served.check_acts()
        await served.do("stop_recording", outcome="success")

    assert [run.facts["state"] for run in run_served("ro", scenario)] == ["finished"]


def test_a_recorder_that_is_stopped_and_killed(run_served: Callable[..., list[Any]]) -> None:
    async def scenario(served: Served) -> None:
        await served.start()
        run = (await served.do("start_recording", name="frozen"))["id"]
        await served.check_acts()
        recorder = recorder_pid(served.pid)
        assert recorder is not None
        os.kill(recorder, signal.SIGSTOP)
        await served.check_acts()
        # after 10 s
        await served.until(lambda now: now["restarts"] > 0 and now["recording"] == run)
        await served.check_acts()
        recorder = recorder_pid(served.pid)
        assert recorder is not None
        os.kill(recorder, signal.SIGKILL)
        await served.check_acts()
        await served.until(lambda now: now["restarts"] > 1 and now["recording"] == run)
        await served.check_acts()
        await served.do("stop_recording", outcome="success")

    runs = run_served("rw", scenario)
    assert len(next(run for run in runs if run.kind == "recording").files) >= 3
