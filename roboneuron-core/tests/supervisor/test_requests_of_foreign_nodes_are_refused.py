"""A foreign node may call a module's services; only requests of the module's own server are
executed, others are reported.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState

from rn_testing.fakes import fake_plan
from roboneuron.config import Config
from roboneuron.errors import NotReadyError
from roboneuron.modules.requests import Announcements, digest_of, parameters_request
from roboneuron.ros.link import RosLink
from roboneuron.supervisor.lifecycle import NodeClient
from roboneuron.supervisor.process import ProcessEvents, spawn
from roboneuron.supervisor.supervisor import Supervisor

MakeConfig = Callable[..., Config]


def transition_request(number: int, label: str) -> ChangeState.Request:
    return ChangeState.Request(transition=Transition(id=number, label=label))


def test_what_was_announced_is_taken_once_and_in_any_pieces() -> None:
    announced = Announcements()
    first = digest_of(transition_request(3, "activate"))
    second = digest_of(parameters_request({"instruction": "go", "act_from_ns": 3}))
    assert announced.take(first), "a module without a server belongs to whoever calls"
    stream = b"\n" + first + b"\n\n" + second + b"\n"
    for i in range(0, len(stream), 7):
        announced.feed(stream[i : i + 7])
    assert not announced.take(digest_of(transition_request(3, "shutdown"))), (
        "the node would go by the label"
    )
    assert announced.take(second)
    assert announced.take(first)
    assert not announced.take(first)
    assert not announced.take(second)


@pytest.mark.ros
@pytest.mark.parametrize("fault", ["reads-stdin-late", "has-a-child-that-reads"])
def test_the_server_s_own_requests_are_known_whoever_reads_their_announcements_and_when(
    supervisor: Supervisor, make_config: MakeConfig, fault: str
) -> None:
    """The thread that reads stdin may not get processor time; processes started by a plugin may
    read its stdin too.
    """
    view = supervisor.start(fake_plan("inference", make_config(inference=fault)))
    assert view.process is not None
    own = NodeClient(supervisor.link, supervisor.changes, "/fake/inference", view.process.announce)
    for round_ in range(10):
        assert own.set({"instruction": f"own {round_}"}, 10.0) == ""
    report = supervisor.view("inference").report
    assert report is not None
    assert report.dropped_by == {}
    supervisor.stop("inference")


def test_a_request_that_cannot_be_announced_is_not_sent(tmp_path: Path) -> None:
    """The pipe of a hung process fills up; a lost announcement would make the request look
    foreign.
    """
    log = tmp_path / "log" / "hangs.log"
    process = spawn("hangs", ["sleep", "60"], os.environ, "", log, ProcessEvents())
    process.reap(lambda ended: None)

    def announce_on() -> None:
        for _ in range(100_000):
            process.announce(b"x" * 64)

    try:
        with pytest.raises(NotReadyError, match="does not read"):
            announce_on()
        process.beat()
    finally:
        process.kill()
        assert process.wait(10.0)
    process.announce(b"x" * 64)


def test_a_signal_leaves_what_has_ended_to_who_waits_for_it(tmp_path: Path) -> None:
    """If another thread reaps it, its exit status is lost, and it would count as running
    forever.
    """
    process = spawn(
        "ends", ["true"], os.environ, "", tmp_path / "log" / "ends.log", ProcessEvents()
    )
    os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
    process.terminate()
    process.kill()
    process.reap(lambda ended: None)
    assert process.wait(10.0)
    assert process.exit_code == 0


@pytest.fixture
def foreign(supervisor: Supervisor) -> Iterator[RosLink]:
    """Another node on the graph."""
    assert supervisor.link  # joins the graph first, because the environment has to be prepared
    link = RosLink("meddler")
    link.open()
    yield link
    link.close()


@pytest.mark.ros
def test_foreign_requests_are_refused_and_reported_by_name(
    supervisor: Supervisor, foreign: RosLink, make_config: MakeConfig
) -> None:
    from lifecycle_msgs.srv import GetState
    from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
    from rcl_interfaces.srv import SetParameters, SetParametersAtomically

    supervisor.start(fake_plan("robot", make_config()))
    changes = supervisor.changes

    def ask(service_type: Any, name: str, request: Any) -> Any:
        path = f"/fake/robot/{name}"
        assert changes.wait_for(lambda: foreign.is_service_ready(service_type, path), 10.0)
        call = foreign.call(service_type, path, request, changes.notify)
        assert changes.wait_for(call.done, 10.0), "it is answered"
        return call.result()

    def refused() -> int:
        report = supervisor.view("robot").report
        return 0 if report is None else report.dropped_by.get("foreign_request", 0)

    sim_time = Parameter(
        name="use_sim_time",
        value=ParameterValue(type=ParameterType.PARAMETER_BOOL, bool_value=True),
    )
    for number, label in ((4, "deactivate"), (7, "shutdown"), (0, "deactivate"), (4, "")):
        request = transition_request(number, label)
        assert not ask(ChangeState, "change_state", request).success
    odd = Parameter(name="instruction", value=ParameterValue(type=99))
    for parameters in ([sim_time, sim_time], [sim_time, odd]):
        answer = ask(SetParameters, "set_parameters", SetParameters.Request(parameters=parameters))
        assert [result.successful for result in answer.results] == [False, False]
    assert "only the server" in answer.results[0].reason
    atomic = SetParametersAtomically.Request(parameters=[sim_time])
    assert not ask(SetParametersAtomically, "set_parameters_atomically", atomic).result.successful
    assert ask(GetState, "get_state", GetState.Request()).current_state.label == "active", (
        "reading is for everybody"
    )

    assert changes.wait_for(lambda: refused() == 7, 5.0)
    report = supervisor.view("robot").report
    assert report is not None
    assert report.state == "active"
    assert "/meddler" in report.metrics["foreign_request"]
    assert "roboneuron_server" not in report.metrics["foreign_request"]
    stopped = supervisor.stop("robot")
    assert not stopped.killed


@pytest.mark.ros
def test_the_server_s_own_requests_are_followed_beside_foreign_ones(
    supervisor: Supervisor, foreign: RosLink, make_config: MakeConfig
) -> None:
    view = supervisor.start(fake_plan("inference", make_config()))
    assert view.process is not None
    own = NodeClient(supervisor.link, supervisor.changes, "/fake/inference", view.process.announce)
    other = NodeClient(foreign, supervisor.changes, "/fake/inference", lambda digest: None)
    for round_ in range(10):
        assert "only the server" in other.set({"instruction": f"foreign {round_}"}, 5.0)
        assert own.set({"instruction": f"own {round_}"}, 5.0) == ""
        report = supervisor.changes.wait_for(
            lambda round_=round_: (
                (seen := supervisor.view("inference").report)
                and seen.instruction == f"own {round_}"
                and seen
            ),
            5.0,
        )
        assert report, "the server's instruction is set"


@pytest.mark.ros
def test_a_call_that_is_given_up_is_forgotten(foreign: RosLink) -> None:
    """Otherwise rclpy would keep the request for an answer that never comes."""
    given_up = threading.Event()
    call = foreign.call(GetState, "/nobody/get_state", GetState.Request(), given_up.set)
    client = foreign._client(GetState, "/nobody/get_state")
    assert len(client._pending_requests) == 1
    call.cancel()
    assert given_up.is_set()
    assert not call.done()
    assert client._pending_requests == {}
