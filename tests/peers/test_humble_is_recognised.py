"""Discovery messages of a ROS 2 Humble process, from a stand-in: recognised, reported in one
sentence, and no process's memory grows.
"""

from __future__ import annotations

import subprocess
from collections.abc import Iterator

import pytest
from foreign import MARKS, Server, cyclone, running, until

pytestmark = MARKS
TOLD = "as ROS 2 Humble and older do"
MESSAGES = 10_000
DEFINITION = "another definition"
MOST_MIB = 8.0
"""Limit of the server's growth; one that kept the messages, of about 1 KB, would grow by 10 MiB."""


@pytest.fixture(scope="module")
def humble(server: Server) -> Iterator[subprocess.Popen[str]]:
    """The stand-in."""
    with running(*cyclone(server, "humble_program.py")) as process:
        yield process


def row(table: dict[str, dict[str, str]]) -> dict[str, str]:
    """The stand-in's row; it only has a topic, and nothing of Humble's own DDS."""
    untried = ("1 MB", "service", "action", "lifecycle", "QoS that does not fit")
    return table.setdefault("Humble, a stand-in", dict.fromkeys(untried, "-"))


def tell(humble: subprocess.Popen[str], count: int) -> str:
    """Send this many discovery messages; return its report once all are acknowledged."""
    assert humble.stdin is not None
    assert humble.stdout is not None
    humble.stdin.write(f"{count}\n")
    humble.stdin.flush()
    return humble.stdout.readline().strip()


def test_it_is_named_by_tools_and_doctor(
    server: Server, humble: subprocess.Popen[str], table: dict[str, dict[str, str]]
) -> None:
    problems = until(lambda: server.problems("old"))
    assert len(problems) == 1
    assert TOLD in problems[0]
    assert "ROS_DOMAIN_ID" in problems[0]
    assert server.problems("large") == []
    told = server.doctor()
    assert TOLD in told
    assert "Its topics: /fr3/old." in told
    assert server.do("read_old")["messages"][0]["data"] == "old"
    row(table).update({"topic": "read", DEFINITION: "told: no hashes"})


def test_its_discovery_does_not_grow_the_server(
    server: Server, humble: subprocess.Popen[str], table: dict[str, dict[str, str]]
) -> None:
    until(lambda: server.problems("old"))
    warm = MESSAGES // 10
    assert tell(humble, warm) == str(warm)
    server.do("list_nodes")
    before = server.process.memory_info().rss
    assert tell(humble, MESSAGES) == str(warm + MESSAGES)
    server.do("list_nodes")
    grown = (server.process.memory_info().rss - before) / 2**20
    assert grown < MOST_MIB
    assert server.problems("old"), "the graph is still seen"
    row(table)["recognised as"] = (
        f"Humble or older; {MESSAGES} discovery messages: {grown:+.1f} MiB"
    )
