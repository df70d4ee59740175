"""Every kind of entity x every way in which its creation or callback fails: the caller gets an
error that names it, and the executor serves the next one.
"""

from __future__ import annotations

import itertools
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from control_msgs.action import FollowJointTrajectory, GripperCommand
from rclpy.action import ActionClient, ActionServer
from rclpy.node import Node
from rclpy.qos import QoSProfile
from std_msgs.msg import Bool, String
from std_srvs.srv import SetBool, Trigger

from rn_testing.waiting import wait_until
from roboneuron.errors import ConfigurationError, InternalError, StateError
from roboneuron.ros.environment import prepare_environment
from roboneuron.ros.link import RosLink
from roboneuron.supervisor.connection import Connection

pytestmark = [pytest.mark.ros, pytest.mark.timeout(60)]
SOON_S = 10.0
Make = Callable[[Node, Any, str, Any], object]
KINDS: dict[str, tuple[type, type, Make]] = {
    "subscription": (
        Bool,
        String,
        lambda node, kind, name, qos: node.create_subscription(kind, name, lambda _: None, qos),
    ),
    "publisher": (
        Bool,
        String,
        lambda node, kind, name, qos: node.create_publisher(kind, name, qos),
    ),
    "client": (
        SetBool,
        Trigger,
        lambda node, kind, name, qos: node.create_client(kind, name, qos_profile=qos),
    ),
    "service": (
        SetBool,
        Trigger,
        lambda node, kind, name, qos: node.create_service(
            kind, name, lambda request, response: response, qos_profile=qos
        ),
    ),
    "action client": (
        FollowJointTrajectory,
        GripperCommand,
        lambda node, kind, name, qos: ActionClient(node, kind, name, goal_service_qos_profile=qos),
    ),
}
QOS = QoSProfile(depth=1)


class NoType:
    """Neither a message nor a service."""


@pytest.fixture(scope="module")
def link(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RosLink]:
    prepare_environment(Path(tmp_path_factory.mktemp("ros")))
    made = RosLink("worker", lambda: pytest.fail("the ROS thread has ended"))
    made.open()
    yield made
    made.close()


@pytest.fixture(autouse=True)
def _serves_afterwards(link: RosLink, request: pytest.FixtureRequest) -> Iterator[None]:
    """After each test a new subscription receives a message."""
    yield
    came = threading.Event()
    topic = "/alive"
    end = link.subscribe(Bool, topic, lambda _: came.set())
    send = link.advertise(Bool, topic)

    def is_received() -> bool:
        send(Bool(data=True))
        return came.wait(0.05)

    wait_until(is_received, SOON_S, "the executor serves no new subscription")
    end()


def create(link: RosLink, noun: str, ros_type: Any, name: str, qos: Any = QOS) -> object:
    make = KINDS[noun][2]
    return link.create(noun, name, ros_type, lambda node: make(node, ros_type, name, qos))


@pytest.mark.parametrize(
    ("noun", "first"),
    [
        *itertools.product(("subscription", "publisher"), repeat=2),
        *itertools.product(("client", "service"), repeat=2),
        ("action client", "action client"),
    ],
)
def test_a_name_that_has_another_type_here_is_refused_with_both(
    link: RosLink, noun: str, first: str
) -> None:
    kind, other, _ = KINDS[noun]
    name = f"/other/{first}_{noun}".replace(" ", "_")
    kept = create(link, first, other, name)
    with pytest.raises(ConfigurationError) as raised:
        create(link, noun, kind, name)
    assert kind.__name__ in raised.value.message
    assert other.__name__ in raised.value.message
    assert name in raised.value.message
    assert kept is not None


def test_a_topic_of_the_node_itself_is_refused_with_both_types(link: RosLink) -> None:
    with pytest.raises(ConfigurationError) as raised:
        link.subscribe(Bool, "/parameter_events", lambda _: None)
    for part in ("/parameter_events", "std_msgs/msg/Bool", "rcl_interfaces/msg/ParameterEvent"):
        assert part in raised.value.message
    with pytest.raises(ConfigurationError):
        link.advertise(Bool, "/parameter_events")


@pytest.mark.parametrize("noun", KINDS)
@pytest.mark.parametrize("name", ["/a b", "/a//b", "/1a", "", "/a/", "/a\nb", "/ä"])
def test_an_invalid_name_is_refused(link: RosLink, noun: str, name: str) -> None:
    with pytest.raises(ConfigurationError) as raised:
        create(link, noun, KINDS[noun][0], name)
    assert noun in raised.value.message


@pytest.mark.parametrize("noun", KINDS)
@pytest.mark.parametrize("qos", [None, "best effort", object()], ids=["none", "text", "object"])
def test_an_invalid_quality_of_service_is_refused(link: RosLink, noun: str, qos: object) -> None:
    with pytest.raises(ConfigurationError, match="/of_quality"):
        create(link, noun, KINDS[noun][0], "/of_quality", qos)


@pytest.mark.parametrize(
    ("noun", "kind"),
    [
        (noun, kind)
        for noun, (own, _, _) in KINDS.items()
        for kind in (int, None, NoType, Bool, SetBool, FollowJointTrajectory)
        if kind is not own
    ],
)
def test_a_type_that_cannot_be_used_is_refused(link: RosLink, noun: str, kind: Any) -> None:
    with pytest.raises(ConfigurationError, match="/of_type"):
        create(link, noun, kind, "/of_type")


@pytest.mark.parametrize("noun", KINDS)
def test_a_node_that_is_gone_is_named(link: RosLink, noun: str) -> None:
    gone = link.on_executor(lambda: Node("gone", context=link.node.context))
    link.on_executor(gone.destroy_node)
    kind, _, make = KINDS[noun]
    from roboneuron.ros.executor import created

    with pytest.raises(StateError, match="/of_nobody"):
        link.on_executor(
            lambda: created(
                gone, noun, "/of_nobody", kind, lambda: make(gone, kind, "/of_nobody", QOS)
            )
        )


@pytest.mark.parametrize("period", [None, float("nan"), float("inf"), 1e30])
def test_a_timer_that_cannot_be_made_is_refused(link: RosLink, period: Any) -> None:
    with pytest.raises(ConfigurationError, match="timer"):
        link.create("timer", "of the test", None, lambda node: node.create_timer(period, print))


def test_what_is_destroyed_twice_or_is_nothing_ends_nothing(link: RosLink) -> None:
    end = link.subscribe(Bool, "/twice", lambda _: None)
    end()
    end()
    node = link.node
    for destroy in (
        node.destroy_publisher,
        node.destroy_client,
        node.destroy_service,
        node.destroy_timer,
    ):
        assert link.on_executor(lambda destroy=destroy: destroy(None)) is False  # type: ignore[misc]


@pytest.mark.parametrize(
    "error", [ValueError("no"), SystemExit(3), KeyboardInterrupt(), GeneratorExit()], ids=repr
)
def test_a_task_s_exception_is_its_caller_s(link: RosLink, error: BaseException) -> None:
    def task() -> None:
        raise error

    with pytest.raises(type(error)) as raised:
        link.on_executor(task)
    assert raised.value is error


def raising(error: type[BaseException], called: threading.Event) -> Callable[..., Any]:
    def callback(*_: Any) -> Any:
        called.set()
        raise error("a callback")

    return callback


@pytest.mark.parametrize("error", [ValueError, SystemExit])
@pytest.mark.parametrize("source", ["subscription", "timer", "service", "answer", "guard", "goal"])
def test_a_callback_that_raises_ends_only_itself(
    link: RosLink, source: str, error: type[BaseException]
) -> None:
    called, node, name = threading.Event(), link.node, f"/raises/{source}_{error.__name__}"
    fails = raising(error, called)
    act: Callable[[], object] = lambda: None  # noqa: E731
    if source == "subscription":
        link.on_executor(lambda: node.create_subscription(Bool, name, fails, 1))
        send = link.advertise(Bool, name)
        act = lambda: send(Bool())  # noqa: E731
    elif source == "timer":
        timer = link.on_executor(lambda: node.create_timer(0.01, fails))
    elif source in ("service", "answer"):
        answers = fails if source == "service" else lambda request, response: response
        link.on_executor(lambda: node.create_service(SetBool, name, answers))
        wait_until(lambda: link.is_service_ready(SetBool, name), SOON_S, "no service")
        link.call(SetBool, name, SetBool.Request(), fails if source == "answer" else print)
    elif source == "guard":
        guard = link.on_executor(lambda: node.create_guard_condition(fails))
        act = guard.trigger
    else:
        server = link.on_executor(
            lambda: ActionServer(node, GripperCommand, name, lambda goal: None, goal_callback=fails)
        )
        client = link.on_executor(lambda: ActionClient(node, GripperCommand, name))
        wait_until(client.server_is_ready, SOON_S, "no server")
        link.on_executor(lambda: client.send_goal_async(GripperCommand.Goal()))

    def is_called() -> bool:
        act()
        return called.wait(0.05)

    wait_until(is_called, SOON_S, "the callback is not called")
    if source == "timer":
        link.on_executor(lambda: node.destroy_timer(timer))
    if source == "goal":
        link.on_executor(server.destroy)
        link.on_executor(client.destroy)


def test_work_is_done_at_once_on_the_executor_s_own_thread(link: RosLink) -> None:
    assert link.on_executor(lambda: link.on_executor(threading.current_thread)).name == "ros-link"
    assert link.on_executor(lambda: link.is_service_ready(Trigger, "/nobody")) is False


def test_who_waits_for_a_hanging_thread_gets_an_error_and_nobody_waits_again(
    link: RosLink, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("roboneuron.ros.link._TASK_TIMEOUT_S", 0.3)
    hangs, begun, done = threading.Event(), threading.Event(), list[str]()
    holder = threading.Thread(
        target=lambda: link.on_executor(lambda: (begun.set(), hangs.wait(SOON_S))), daemon=True
    )
    monkeypatch.setattr(threading, "excepthook", lambda _: None)
    holder.start()
    assert begun.wait(SOON_S)
    with pytest.raises(InternalError, match="did not answer"):
        link.on_executor(lambda: done.append("late"))
    monkeypatch.setattr("roboneuron.ros.link._TASK_TIMEOUT_S", 3600.0)
    with pytest.raises(InternalError, match="did not answer"):
        link.on_executor(lambda: done.append("again"))
    hangs.set()
    holder.join(SOON_S)

    def works() -> bool:
        with suppress(InternalError):
            return link.on_executor(lambda: True)
        return False

    wait_until(works, SOON_S, "it does not work again")
    assert done == [], "work is begun although its caller has given up"


@pytest.fixture
def lost() -> Iterator[tuple[RosLink, threading.Event]]:
    told = threading.Event()
    made = RosLink("loses", told.set)
    made.open()
    yield made, told
    made.close()


def break_waits(link: RosLink) -> None:
    """Make every further wait for callbacks fail, as an entity without a handle would."""

    def fail(*_: object) -> None:
        raise RuntimeError("an entity without a handle")

    def replace() -> None:
        link.node.executor.wait_for_ready_callbacks = fail

    link.on_executor(replace)


def test_a_server_whose_thread_has_ended_ends_as_by_sigterm(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its modules hold and leave with it, instead of a server that hears and commands nothing."""
    monkeypatch.setattr("roboneuron.ros.executor._LOST_S", 0.1)
    told = threading.Event()
    connection = Connection(lambda message: None, tmp_path)
    before = signal.signal(signal.SIGTERM, lambda *_: told.set())
    try:
        break_waits(connection.link())
        wait_until(told.is_set, SOON_S, "the server is not ended")
    finally:
        signal.signal(signal.SIGTERM, before)
        connection.close()


def test_a_thread_that_ends_all_the_same_is_told(
    lost: tuple[RosLink, threading.Event], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing can be waited for any more: what waits for the thread gets an error at once."""
    link, told = lost
    monkeypatch.setattr("roboneuron.ros.executor._LOST_S", 0.1)
    break_waits(link)
    assert told.wait(SOON_S)
    with pytest.raises(InternalError, match="has ended"):
        link.on_executor(lambda: None)


def test_the_end_of_an_open_link_is_no_loss() -> None:
    told = threading.Event()
    link = RosLink("leaves", told.set)
    link.open()
    link.close()
    assert not told.is_set()
    with pytest.raises(InternalError, match="not open"):
        link.on_executor(lambda: None)
