"""Rows of the fault matrix: clients that race, flood, fall silent and vanish, a frozen server, a
full disk.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import anyio
import pytest
from fault_loop import JointWitness, config_text, environment
from served_cell import LEASE_S, SERVER, SERVER_TIMEOUT_S, Cell

from rn_testing.waiting import wait_until
from roboneuron.ros.environment import prepare_environment

pytestmark = [pytest.mark.ros, pytest.mark.timing, pytest.mark.timeout(150)]
VANISHING = """
import json, sys, anyio, httpx2
from mcp import Client
from mcp.client.streamable_http import streamable_http_client

async def main():
    async with (
        httpx2.AsyncClient(headers={"Authorization": "Bearer " + sys.argv[2]}, timeout=60) as http,
        Client(streamable_http_client(sys.argv[1], http_client=http)) as client,
    ):
        await client.call_tool("publish_arm_sequence", json.loads(sys.argv[3]))

anyio.run(main)
"""


async def flood(port: int, token: str, tool: str, at_once: int) -> Counter[str]:
    """Results of 1,000 calls, with this concurrency, each over its own connection.

    Hand-written HTTP, so that clients take no time. A result is "served", the code of an error, or
    "HTTP 503".
    """
    meta = {
        "io.modelcontextprotocol/protocolVersion": "2026-07-28",
        "io.modelcontextprotocol/clientInfo": {"name": "flood", "version": "1"},
        "io.modelcontextprotocol/clientCapabilities": {},
    }
    call = {
        "jsonrpc": "2.0",
        "id": 1,
        "method": "tools/call",
        "params": {"name": tool, "arguments": {}, "_meta": meta},
    }
    body = json.dumps(call).encode()
    head = (
        f"POST /mcp HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nAuthorization: Bearer "
        f"{token}\r\nConnection: close\r\n"
        "Content-Type: application/json\r\nAccept: application/json, text/event-stream\r\n"
        f"Mcp-Protocol-Version: 2026-07-28\r\nMcp-Method: tools/call\r\nMcp-Name: {tool}\r\n"
        f"Content-Length: {len(body)}\r\n\r\n"
    ).encode()
    results: Counter[str] = Counter()
    places = anyio.Semaphore(at_once)

    async def one() -> None:
        async with places, await anyio.connect_tcp("127.0.0.1", port) as stream:
            await stream.send(head + body)
            received = bytearray()
            with contextlib.suppress(anyio.EndOfStream):
                while True:
                    received += await stream.receive()
        status = int(received.split()[1])
        if status != 200:
            results[f"HTTP {status}"] += 1
            return
        text = received[received.index(b'{"jsonrpc"') :].decode()
        answer = json.JSONDecoder().raw_decode(text)[0]["result"]
        results[
            answer["_meta"]["roboneuron/error"]["code"] if answer.get("isError") else "served"
        ] += 1

    async with anyio.create_task_group() as group:
        for _ in range(1000):
            group.start_soon(one)
    return results


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cell]:
    folder = tmp_path_factory.mktemp("served")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    path = folder / "roboneuron.toml"
    control = f"server_timeout_s = {SERVER_TIMEOUT_S}"
    path.write_text(
        config_text(folder, 10.0, control=control) + SERVER.format(port=port, lease_s=LEASE_S)
    )
    command = [
        sys.executable,
        "-m",
        "roboneuron.cli.main",
        "serve",
        "--config",
        str(path),
        "--log-level",
        "warning",
    ]
    with environment(folder), (folder / "server.log").open("wb") as log:
        prepare_environment(folder / "log")
        from roboneuron.ros.link import RosLink

        tokens = {f"TEST_{name.upper()}": f"the-token-of-test-{name}" for name in ("ann", "bob")}
        link = RosLink("witness")
        link.open()
        process = subprocess.Popen(
            command, env=os.environ | tokens, stdin=subprocess.DEVNULL, stderr=log
        )
        try:

            def is_open() -> bool:
                with socket.socket() as probe:
                    return probe.connect_ex(("127.0.0.1", port)) == 0

            wait_until(lambda: process.poll() is not None or is_open(), 60.0, "the server listens")
            assert process.poll() is None, (folder / "server.log").read_text()
            made = Cell(
                process,
                folder,
                f"http://127.0.0.1:{port}/mcp",
                JointWitness(link.node, link.on_executor),
            )
            with made.connected():
                yield made
        finally:
            process.terminate()
            process.wait(30)
            link.close()


def test_of_two_clients_that_race_one_operates_the_robot(cell: Cell) -> None:
    with ThreadPoolExecutor(2) as pool:
        answers = dict(
            zip(
                ("ann", "bob"),
                pool.map(lambda c: c.answer("start_robot"), (cell.ann, cell.bob)),
                strict=True,
            )
        )
    refused = [name for name, answer in answers.items() if answer.is_error]
    assert len(refused) == 1
    loser = cell.ann if refused == ["ann"] else cell.bob
    assert "operates the robot" in loser.fail("start_control")
    cell.ann.do("take_over")
    cell.start_loop()
    before = cell.witness.actions()
    assert "refused" in cell.bob.fail("set_instruction", instruction="something else")
    assert "refused" in cell.bob.fail("start_inference")
    assert cell.ann.module("inference")["instruction"] == "move on"
    wait_until(lambda: cell.witness.actions() > before + 3, 2.0, "the arm moves on")


def test_a_thousand_calls_at_once_are_answered_or_refused_and_the_arm_goes_on(cell: Cell) -> None:
    cell.start_loop()
    server = Path(f"/proc/{cell.process.pid}/status")

    def threads() -> int:
        return int(server.read_text().split("Threads:")[1].split()[0])

    before, started_s = threads(), time.monotonic()
    port = int(cell.url.split(":")[2].split("/")[0])
    # a client has a share of the calls and of the connections
    words = {"served", "not_ready", "HTTP 503"}
    for at_once in (200, 1000):
        begun_s = time.monotonic()
        if at_once == 1000:
            cell.alive.clear()  # an exhausted server refuses every client
        answers = anyio.run(flood, port, "the-token-of-test-bob", "heartbeat", at_once)
        print(
            f"1000 calls, {at_once} at once, took {time.monotonic() - begun_s:.1f} s: "
            f"{dict(answers)}"
        )
        assert answers.total() == 1000
        assert set(answers) <= words, "each one is told"
        assert at_once == 1000 or answers["served"] > 50
    cell.ann.do("heartbeat")
    cell.alive.set()
    pauses = [b - a for (a, _), (b, _) in itertools.pairwise(cell.witness.changes(started_s))]
    # it may hold when the machine is overloaded
    print(f"longest pause of the arm: {max(pauses):.2f} s")
    wait_until(cell.witness.moves, 5.0, "the arm moves on")
    assert cell.ann.module("control")["health"] == "ok"
    wait_until(lambda: threads() <= before + 10, 10.0, "threads of the flood have ended")


def test_a_server_that_is_frozen_makes_the_arm_stand_until_somebody_asks_for_motion(
    cell: Cell,
) -> None:
    cell.start_loop()
    cell.alive.clear()
    time.sleep(0.2)
    cell.process.send_signal(signal.SIGSTOP)
    try:
        time.sleep(SERVER_TIMEOUT_S + 0.3)  # a busy machine may make the arm pause before
        wait_until(cell.witness.stands, 1.5, "the arm stands")
    finally:
        cell.process.send_signal(signal.SIGCONT)
        cell.alive.set()
    time.sleep(1.0)  # to show that nothing happens
    assert cell.witness.stands(), "a server that lives again starts nothing"
    wait_until(lambda: "sign of life" in str(cell.ann.do("get_status")), 3.0, "the status says why")
    # A module may report the silence only now: "Motion was forbidden meanwhile. Ask again."
    wait_until(
        lambda: not cell.ann.answer("set_instruction", instruction="swing").is_error,
        5.0,
        "it is asked for",
    )
    wait_until(cell.witness.moves, 3.0, "the arm moves again")


@pytest.mark.parametrize(
    "target", ["/dev/full", "/proc/sys/kernel/osrelease"], ids=["full", "read-only"]
)
def test_without_an_audit_nothing_is_sent_directly_and_the_stop_still_works(
    cell: Cell, target: str
) -> None:
    cell.start_loop()
    audit = cell.folder / "state" / "audit.jsonl"
    kept = audit.with_suffix(".kept")
    if audit.exists():
        audit.rename(kept)
    audit.symlink_to(target)
    try:
        assert cell.witness.moves() or wait_until(cell.witness.moves, 1.0, "the policy goes on")
        assert "audit" in cell.bob.fail("take_over")
        stopped = cell.bob.do("emergency_stop", reason="the disk is full")
        assert set(stopped["confirmed_by"]) == {"robot", "perception", "inference", "control"}
        wait_until(cell.witness.stands, 2.0, "the arm stands")
        assert "audit" in cell.ann.fail("reset_emergency_stop")
        audit.unlink()
        assert "give an instruction" in cell.ann.do("reset_emergency_stop")["note"]
        time.sleep(1.0)  # to show that nothing happens
        assert cell.witness.stands(), "a release starts nothing"
        cell.ann.do("set_instruction", instruction="swing")
        wait_until(cell.witness.moves, 3.0, "the arm moves again")
        cell.ann.do("stop_inference")
        wait_until(cell.witness.stands, 2.0, "the arm stands")
        audit.unlink(missing_ok=True)
        audit.symlink_to(target)
        since_s, step = time.monotonic(), move_from(cell.witness.joints()[-1][1], 1)[0]
        assert "audit" in cell.ann.fail("publish_arm", **step)
        assert cell.witness.changes(since_s) == []
        audit.unlink()
        cell.ann.do("publish_arm", **step)
        wait_until(
            lambda: len(cell.witness.changes(since_s)) > 0,
            2.0,
            "it moves once the audit can be written",
        )
    finally:
        audit.unlink(missing_ok=True)
        if kept.exists():
            kept.rename(audit)


def move_from(x_m: float, steps: int) -> list[dict[str, Any]]:
    """Steps of 3 mm in 0.1 s each along the first joint."""
    return [
        {
            "message": {
                "joint_names": ["slide_x"],
                "points": [
                    {
                        "positions": [x_m + 0.003 * (i + 1)],
                        "time_from_start": {"sec": 0, "nanosec": 100_000_000},
                    }
                ],
            },
        }
        for i in range(steps)
    ]


def test_a_client_that_is_gone_in_a_sequence_leaves_an_arm_that_stands(cell: Cell) -> None:
    if cell.ann.module("inference")["phase"] == "running":
        cell.ann.do("stop_inference")
    wait_until(cell.witness.stands, 3.0, "the arm stands")
    started_s = time.monotonic()
    arguments = json.dumps({"steps": move_from(cell.witness.joints()[-1][1], 100)})
    client = subprocess.Popen(
        [sys.executable, "-c", VANISHING, cell.url, "the-token-of-test-ann", arguments]
    )
    try:
        wait_until(
            lambda: len(cell.witness.changes(started_s)) > 5, 20.0, "the sequence moves the arm"
        )
        assert client.poll() is None
    finally:
        client.kill()
        client.wait(5)
    gone_s = time.monotonic()
    wait_until(cell.witness.stands, 2.0, "the arm stands")
    last = cell.witness.moved_s()
    assert last is not None
    print(f"the last motion was {(last - gone_s) * 1e3:.0f} ms after the client's end")
    assert last - gone_s < 1.0
    assert {m["health"] for m in cell.ann.do("get_status")["modules"]} <= {
        "ok",
        "stopped",
        "waiting",
        "failing",
    }


def test_an_operator_who_falls_silent_loses_the_robot_and_the_arm_stands(cell: Cell) -> None:
    cell.start_loop()
    cell.alive.clear()
    silent_s = time.monotonic()
    wait_until(
        lambda: cell.bob.module("inference")["phase"] == "stopped",
        LEASE_S + 5.0,
        "the policy is stopped",
    )
    wait_until(cell.witness.stands, 2.0, "the arm stands")
    last = cell.witness.moved_s()
    assert last is not None
    assert last - silent_s < LEASE_S + 2.0
    incidents = cell.bob.do("list_incidents")["incidents"]
    assert any(i["what"] == "lease" and "'ann' has lapsed" in i["explanation"] for i in incidents)
    audit = [
        json.loads(line)
        for line in (cell.folder / "state" / "audit.jsonl").read_text().splitlines()
    ]
    assert any(a["verdict"] == "lapsed" and a["who"] == "ann" for a in audit)
    cell.operator = cell.bob
    cell.alive.set()
    cell.bob.do("start_inference", instruction="move on")
    assert "operates the robot" in cell.ann.fail("set_instruction", instruction="go")
    wait_until(cell.witness.moves, 3.0, "the arm moves for the new operator")
