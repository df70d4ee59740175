"""A node's name is held by one process of the machine, and released when it ends in any way."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator

import pytest

from rn_testing.waiting import wait_for_line
from roboneuron.errors import StateError
from roboneuron.ros.claim import claim, claimant

HOLD = """
import sys
from roboneuron.ros.claim import claim
held = claim(sys.argv[1])
print("held", flush=True)
sys.stdin.read()
"""


@pytest.fixture
def node() -> str:
    return f"/cell_{os.getpid()}/robot"


@pytest.fixture
def other(node: str) -> Iterator[subprocess.Popen[str]]:
    """A process that holds the node's name."""
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, node], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        wait_for_line(process.stdout, "held")
        yield process
        process.kill()


def test_nobody_holds_a_node_that_does_not_run(node: str) -> None:
    assert claimant(node) is None


def test_a_second_process_is_told_who_holds_the_node(
    node: str, other: subprocess.Popen[str]
) -> None:
    assert claimant(node) == other.pid
    with pytest.raises(StateError, match=f"{node} runs already, as process {other.pid}") as caught:
        claim(node)
    assert "ROS_DOMAIN_ID" in caught.value.hint
    claim(f"{node}_b").close()


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_a_dead_process_holds_nothing(node: str, other: subprocess.Popen[str], number: int) -> None:
    other.send_signal(number)
    other.wait(10)
    with claim(node):
        assert claimant(node) == os.getpid()
    assert claimant(node) is None


def test_who_leaves_in_time_is_waited_for(node: str, other: subprocess.Popen[str]) -> None:
    threading.Timer(0.3, other.kill).start()
    with claim(node, wait_s=10.0):
        assert claimant(node) == os.getpid()


def test_domains_are_apart(
    node: str, other: subprocess.Popen[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "99" if os.environ.get("ROS_DOMAIN_ID") != "99" else "98")
    assert claimant(node) is None
    claim(node).close()


def test_many_questions_do_not_free_a_node(node: str, other: subprocess.Popen[str]) -> None:
    assert {claimant(node) for _ in range(5000)} <= {other.pid, 0}
    with pytest.raises(StateError, match=r"runs already, as a process of another server"):
        claim(node)
