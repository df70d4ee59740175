"""Nodes of ROS 2 Kilted, from its own wheels, and a program of Cyclone DDS together with a server
that uses Jazzy's wheels: what works, and what is refused or reported instead of hanging.
"""

from __future__ import annotations

import base64
import time
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from foreign import MARKS, WAIT_S, Server, cyclone, kilted, running, until

from roboneuron.ros.environment import prepare_environment
from roboneuron.ros.link import RosLink
from roboneuron.supervisor.changes import Changes
from roboneuron.supervisor.lifecycle import NodeClient

pytestmark = MARKS
MEGABYTE = bytes(range(256)) * 4096
NAMES = {"kilted": "Kilted, its wheels", "cyclone": "Cyclone DDS 11, without ROS"}
REFUSED = "between the two, topics work, services and actions do not"
SOON_S = 5.0
"""A refusal is immediate; the rest is for a busy machine."""
Note = Callable[[str, str], None]


@pytest.fixture(scope="module", params=list(NAMES))
def peer(request: pytest.FixtureRequest, server: Server) -> Iterator[str]:
    """The running peer."""
    command = kilted(server) if request.param == "kilted" else cyclone(server, "cyclone_program.py")
    with running(*command):
        yield request.param


@pytest.fixture
def note(table: dict[str, dict[str, str]], peer: str) -> Note:
    """Record an observation in a column of the peer's row."""
    return table.setdefault(NAMES[peer], {}).__setitem__


def exchange(
    server: Server, send: str, message: dict[str, object], read: str, expected: str
) -> None:
    """Send until the peer repeats it."""

    def answered() -> bool:
        server.do(send, message=message, timeout_s=WAIT_S)
        answer = server.call(read, {"timeout_s": 1.0})
        return not answer.is_error and answer.structured_content["messages"][0]["data"] == expected

    until(answered)


def test_topics_go_both_ways(server: Server, note: Note) -> None:
    exchange(server, "publish_say", {"data": "漢 yes"}, "read_heard", "heard 漢 yes")
    note("topic", "both ways")


def test_a_megabyte_goes_both_ways(server: Server, note: Note) -> None:
    message = {"data": base64.b64encode(MEGABYTE).decode()}
    told = f"{len(MEGABYTE)} {zlib.crc32(MEGABYTE)}"
    exchange(server, "publish_measure", message, "read_measured", told)
    read = server.do("read_large", timeout_s=WAIT_S)["messages"][0]["data"]
    assert (read["length"], read["mean"]) == (len(MEGABYTE), 127.5)
    note("1 MB", "both ways")


def refused_soon(server: Server, tool: str, **arguments: object) -> None:
    """Check that a discovered endpoint is refused quickly in one sentence."""
    until(lambda: REFUSED in server.refusal(tool, **arguments))
    begun_s = time.monotonic()
    said = server.refusal(tool, **arguments)
    assert time.monotonic() - begun_s < SOON_S
    assert "served through Cyclone DDS" in said
    assert "RMW_IMPLEMENTATION" in said


def test_a_service_is_called_or_refused(server: Server, peer: str, note: Note) -> None:
    asked = {"request": {"data": True}, "timeout_s": 2.0}
    if peer == "cyclone":
        refused_soon(server, "call_switch", **asked)
        assert REFUSED in server.problems("switch")[0]
        note("service", "refused")
        return
    called = until(lambda: server.call("call_switch", asked).structured_content)
    assert called["response"] == {"success": True, "message": "switched"}
    assert server.problems("switch") == []
    note("service", "works")


def test_a_goal_is_sent_or_refused(server: Server, peer: str, note: Note) -> None:
    asked = {"goal": {"order": 4}, "server_timeout_s": 2.0}
    if peer == "cyclone":
        refused_soon(server, "send_count_goal", **asked)
        note("action", "refused")
        return
    ended = server.do("send_count_goal", goal={"order": 4}, server_timeout_s=WAIT_S)
    assert (ended["status"], ended["result"]) == ("succeeded", {"sequence": [0, 1, 1, 2]})
    assert ended["feedbacks"] == 1
    note("action", "works")


def test_a_managed_node_is_driven(
    server: Server, peer: str, note: Note, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As the supervisor drives the modules of this project."""
    if peer == "cyclone":
        note("lifecycle", "services: refused")
        pytest.skip("the states of a managed node are services")
    monkeypatch.setenv("ROS_DOMAIN_ID", str(server.domain))
    prepare_environment(tmp_path / "log")
    link = RosLink("drives")
    link.open()
    try:
        changes = Changes()
        node = NodeClient(link, changes, "/fr3/managed", lambda digest: None)
        assert node.wait_until_served(WAIT_S)
        states = [node.state(WAIT_S)]
        for transition in ("configure", "activate", "deactivate"):
            assert node.transition(transition, WAIT_S)
            states.append(node.state(WAIT_S))
        assert states == ["unconfigured", "inactive", "active", "inactive"]
    finally:
        link.close()
    note("lifecycle", "works")


def test_quality_of_service_that_does_not_fit_is_named(
    server: Server, peer: str, note: Note
) -> None:
    if peer == "kilted":
        said = "/fr3/viewer gets nothing from /fr3/peer on /fr3/blurred: "
    else:
        program = "a program that uses Cyclone DDS without ROS"
        said = f"{program} gets nothing from {program} on /fr3/blurred: "
    said += "best effort publisher and reliable subscription."
    until(lambda: said in server.problems("blurred"))
    assert server.do("read_blurred", timeout_s=WAIT_S)["messages"][0]["data"] == "blurred"
    if peer == "cyclone":  # for which ROS shows nothing
        why = "no subscriber that fits, because of a setting of its DDS that ROS does not show"
        until(lambda: why in server.refusal("publish_owned", message={"data": ""}, timeout_s=1.0))
    told = server.doctor()
    assert said in told, told
    assert ("Services of another DDS cannot be called: /fr3/count" in told) == (peer == "cyclone")
    assert ("1 x Cyclone DDS" in told) == (peer == "cyclone")
    note("recognised as", "its nodes" if peer == "kilted" else "Cyclone DDS without ROS")
    note("QoS that does not fit", "named")


def test_another_definition_of_a_type_is_refused(server: Server, peer: str, note: Note) -> None:
    calls = [("publish_seam", "own_msgs/msg/Seam", {"message": {}})]
    if peer == "kilted":
        calls.append(("call_strike", "own_msgs/srv/Strike", {"request": {"seam": {}}}))
    for tool, of, arguments in calls:
        said = f"has another definition of {of} on /fr3/"
        until(lambda t=tool, s=said, a=arguments: s in server.refusal(t, timeout_s=1.0, **a))
    note("another definition", "refused")
