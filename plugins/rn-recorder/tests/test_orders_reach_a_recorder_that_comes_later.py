"""The server's side of the recorder's process: starts that take long, and orders that a dying
recorder took along.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from rn_recorder import process as module
from rn_recorder.feature import Recorder
from rn_recorder.options import RecorderOptions
from rn_recorder.process import RecorderProcess
from rn_testing.waiting import wait_until
from roboneuron import NotReadyError

GARBLES = """
import json, sys
print('{"status": {"recording": ""}}', flush=True)
number = json.loads(sys.stdin.readline())["number"]
print(WORDS % number, flush=True)
sys.stdin.readline()
"""
"""Answers the first order with these words."""
DIES = """
import sys
print('{"status": {"recording": ""}}', flush=True)
sys.stdin.readline()
"""
"""Takes the first order along."""
OBEYS = """
import json, os, sys, threading, time
run = {"id": ""}
def say(**line):
    os.write(1, json.dumps(line).encode() + b"\\n")  # whole, although two threads write
def tell():
    while True:
        say(status={"recording": run["id"]})
        time.sleep(0.05)
threading.Thread(target=tell, daemon=True).start()
for line in sys.stdin:
    order = json.loads(line)
    if order["do"] == "leave":
        break
    if order["do"] == "start":
        run["id"] = order["name"] + "-run"
        say(re=order["number"], id=run["id"])
"""
REPEATS = OBEYS.replace("import json", "seen = []\nimport json").replace(
    """    if order["do"] == "start":""",
    """    seen.append(order.get("name"))
    if order["do"] == "start":""",
)
REPEATS = REPEATS.replace('id=run["id"])', 'id=run["id"], order=order, seen=seen)')
"""Its answers contain the order, and the names of all orders that came."""
SLOW = "import time; time.sleep(1.0)\n" + OBEYS


@pytest.fixture
def keep(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., RecorderProcess]]:
    """Return a function that keeps recorders made of these programs, one after the other, the last
    one again.
    """
    monkeypatch.setattr(module, "_BACKOFF_S", (0.01,))
    kept: list[RecorderProcess] = []

    def start(*programs: str) -> RecorderProcess:
        def spawn(number: int, resume: str, name: str) -> subprocess.Popen[bytes]:
            program = programs[min(number, len(programs) - 1)]
            command = [sys.executable, "-c", program]
            return subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, process_group=0
            )

        process = RecorderProcess(spawn)
        kept.append(process)
        process.start()
        return process

    yield start
    for process in kept:
        process.close()


def test_a_start_that_takes_long_is_waited_for(
    keep: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "STALLED_S", 0.3)
    killed: list[dict[str, Any]] = []
    monkeypatch.setattr(
        RecorderProcess, "_kill", lambda process, child: killed.append(process.status)
    )
    process = keep(SLOW)
    assert process.wait_for_status()
    assert {} not in killed


def test_a_recorder_that_is_stopped_is_replaced(
    keep: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "STALLED_S", 1.0)
    process = keep(OBEYS)
    assert process.wait_for_status()
    stopped = process.pid
    os.kill(stopped, signal.SIGSTOP)
    wait_until(lambda: process.starts >= 2, 60.0)
    assert process.wait_for_status()
    assert process.pid != stopped


def test_who_asks_a_recorder_that_ends_is_told_so_at_once(keep: Callable[..., Any]) -> None:
    process = keep(DIES, OBEYS)
    assert process.wait_for_status()
    with pytest.raises(NotReadyError, match="ended before it answered"):
        process.ask({"do": "start", "name": "mine", "facts": {}}, timeout_s=60.0)


BROKEN = {
    "two lines in one": '{"re": %s, "id": "a"}{"status": {}}',
    "half a line": '{"re": %s, "id": "a',
    "a line of a library": "[RTPS_TRANSPORT_SHM Error] of %s",
    "no object": "[%s]",
    "deep": "[" * 20_000 + "%s",
    "no answer and no status": '{"id": %s}',
    "a status that is none": '{"status": %s}',
    "a number that is none": '{"re": "%s", "id": "a"}',
}


@pytest.mark.parametrize("words", BROKEN.values(), ids=BROKEN)
def test_who_waits_is_told_at_once_of_a_line_that_cannot_be_read(
    keep: Callable[..., Any], caplog: pytest.LogCaptureFixture, words: str
) -> None:
    process = keep(f"WORDS = {words!r}\n{GARBLES}")
    assert process.wait_for_status()
    with pytest.raises(NotReadyError, match="could not be read"):
        process.ask({"do": "start", "name": "mine", "facts": {}}, timeout_s=60.0)
    assert process.broken == 1
    assert [record.levelname for record in caplog.records] == ["ERROR"]
    assert len(caplog.text) < 1000


def test_the_recording_of_a_server_begins_with_the_recorder_that_obeys(
    keep: Callable[..., Any],
) -> None:
    process = keep(DIES, OBEYS)
    Recorder(RecorderOptions())._record(process)
    assert process._resume == ("server-run", "server")
    assert process.starts >= 2


def test_an_order_is_not_executed_after_its_caller_has_given_up(
    keep: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    comes, asked = threading.Event(), RecorderProcess._serve

    def serve(process: RecorderProcess, child: subprocess.Popen[bytes]) -> None:
        comes.wait(60.0)
        asked(process, child)

    monkeypatch.setattr(RecorderProcess, "_serve", serve)
    process = keep(REPEATS)
    with pytest.raises(NotReadyError, match="has not answered"):
        process.ask({"do": "start", "name": "early", "facts": {}}, timeout_s=0.05)
    comes.set()
    assert process.wait_for_status()
    answer = process.ask({"do": "start", "name": "later", "facts": {}}, timeout_s=60.0)
    assert answer["id"] == "later-run"
    assert answer["seen"] == ["later"]


def test_an_order_tells_until_when_it_is_valid(keep: Callable[..., Any]) -> None:
    process = keep(REPEATS)
    before_s = time.monotonic()
    answer = process.ask({"do": "start", "name": "mine", "facts": {}}, timeout_s=60.0)
    share_s = module.VALID_SHARE * 60.0
    assert share_s < 60.0
    assert before_s <= answer["order"]["until_s"] - share_s <= time.monotonic()


def test_a_recording_that_begins_after_its_caller_has_given_up_is_ended() -> None:
    process = RecorderProcess(lambda number, resume, name: pytest.fail("nobody starts it"))
    process._take({"re": 7, "id": "late-run"})
    assert process._orders.get_nowait() == {"do": "stop", "run": "late-run", "facts": {}}
    assert process._answers == {}


def test_nobody_waits_for_a_recorder_that_is_closed() -> None:
    process = RecorderProcess(lambda number, resume, name: pytest.fail("nobody starts it"))
    found: list[bool] = []
    waiting = threading.Thread(target=lambda: found.append(process.wait_for_status()))
    waiting.start()
    process.close()
    waiting.join(30.0)
    assert found == [False]
