"""Who is at the other end: other definitions, another DDS, ROS before Iron, another quality of
service.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from rn_standard.doctor.finding import Severity
from rn_standard.doctor.peers import judge, wait_settled
from roboneuron import ConfigurationError
from roboneuron.direct_path import peers
from roboneuron.direct_path.type_hashes import _own_hash

FAST, CYCLONE = b"\x01\x0f", b"\x01\x10"
RELIABLE = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)
BEST_EFFORT = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
OTHER = f"RIHS01_{'5e' * 32}"
SWITCH = "std_srvs/srv/SetBool"
COUNT = "test_msgs/action/Fibonacci"


def end(
    node: str = "camera",
    *,
    vendor: bytes = FAST,
    process: int = 1,
    qos: QoSProfile = RELIABLE,
    spoken: str = OTHER,
) -> Any:
    """A publisher or subscription."""
    return SimpleNamespace(
        node_name=node,
        node_namespace="/fr3",
        topic_type_hash=spoken,
        endpoint_gid=[*vendor, process, *bytes(13)],
        qos_profile=qos,
    )


class Graph(dict[str, tuple[list[Any], list[Any]]]):
    """Both ends by name of a DDS topic."""

    def dds_publishers(self, topic: str) -> list[Any]:
        return self.get(topic, ([], []))[0]

    def dds_subscriptions(self, topic: str) -> list[Any]:
        return self.get(topic, ([], []))[1]


def served(kind: str, part: str = "", spoken: str = "INVALID", **facts: Any) -> Graph:
    """A server of /fr3/do whose parts have the hashes of this process, or another one in `part`."""
    of = COUNT if kind == "action" else SWITCH
    graph = Graph()
    for name, topic in peers._SERVERS[kind]:
        has = spoken if name == part else _own_hash(of, name)
        ends: tuple[list[Any], list[Any]] = ([], [])
        ends[topic.startswith("rq")].append(end("driver", spoken=has, **facts))
        graph[topic.format("/fr3/do")] = ends
    return graph


@pytest.mark.parametrize("kind", ["service", "action"])
def test_a_server_with_the_same_definition_is_called(kind: str) -> None:
    of = COUNT if kind == "action" else SWITCH
    graph = served(kind)
    peers.check_server(kind, "/fr3/do", of, graph)
    assert peers.problems_of(kind, "/fr3/do", of, graph) == []


@pytest.mark.parametrize(
    ("kind", "part"), [(kind, part) for kind in peers._SERVERS for part, *_ in peers._SERVERS[kind]]
)
def test_another_definition_of_any_part_is_refused(kind: str, part: str) -> None:
    of = COUNT if kind == "action" else SWITCH
    graph = served(kind, part, OTHER)
    with pytest.raises(ConfigurationError, match=f"driver has another definition of {of} on") as e:
        peers.check_server(kind, "/fr3/do", of, graph)
    assert "ros learn graph" in e.value.hint
    assert peers.problems_of(kind, "/fr3/do", of, graph) == [str(e.value)]
    peers.check_server(kind, "/fr3/do", of, served(kind, part, "INVALID"))  # says nothing


@pytest.mark.parametrize("kind", ["service", "action"])
def test_a_server_of_another_dds_is_refused_where_no_other_serves(kind: str) -> None:
    of = COUNT if kind == "action" else SWITCH
    graph = served(kind, vendor=CYCLONE)
    with pytest.raises(ConfigurationError, match="served through Cyclone DDS") as e:
        peers.check_server(kind, "/fr3/do", of, graph)
    assert "rmw_fastrtps_cpp" in e.value.hint
    for name, ends in served(kind).items():
        for these, others in zip(graph[name], ends, strict=True):
            these.extend(others)
    peers.check_server(kind, "/fr3/do", of, graph)


def test_a_client_of_another_definition_refuses_nothing() -> None:
    graph = served("service")
    graph["rq/fr3/doRequest"][0].append(end("client", spoken=OTHER))
    peers.check_server("service", "/fr3/do", SWITCH, graph)


@pytest.mark.parametrize(
    ("offered", "asked", "said"),
    [
        (RELIABLE, RELIABLE, ""),
        (RELIABLE, BEST_EFFORT, ""),
        (BEST_EFFORT, RELIABLE, "best effort publisher and reliable subscription"),
        (RELIABLE, LATCHED, "volatile publisher and transient local subscription"),
        (
            RELIABLE,
            QoSProfile(depth=1, deadline=Duration(seconds=1)),
            "subscription has a deadline, but publisher does not",
        ),
    ],
)
def test_quality_of_service_that_does_not_fit_is_named(
    offered: QoSProfile, asked: QoSProfile, said: str
) -> None:
    ends = ([end("camera", qos=offered)], [end("view", qos=asked, process=2)])
    found = peers.qos_mismatches(Graph({"rt/image": ends}), "/image", frozenset())
    told = [f"/fr3/view gets nothing from /fr3/camera on /image: {said}."] if said else []
    assert found == told


def test_a_node_with_another_subscription_that_fits_misses_nothing() -> None:
    """As those who hear the emergency stop."""
    fits = [end("arm", qos=LATCHED, process=2), end("arm", qos=RELIABLE, process=2)]
    deaf = [end("arm", qos=LATCHED, process=2), end("arm", qos=RELIABLE, process=3)]
    for subscriptions, missed in ((fits, 0), (deaf, 1)):
        graph = Graph({"rt/stop": ([end("cli")], subscriptions)})
        assert len(peers.qos_mismatches(graph, "/stop", frozenset())) == missed


def humble_graph() -> Graph:
    """A process whose discovery messages have no hash, beside one of this ROS."""
    graph = Graph()
    old = end("_NODE_NAME_UNKNOWN_", process=7, spoken="INVALID")
    graph["ros_discovery_info"] = ([end("_NODE_NAME_UNKNOWN_", process=1), old], [])
    graph["rt/old"] = ([old], [])
    graph["rt/new"] = ([end("_CREATED_BY_BARE_DDS_APP_", process=8, spoken="INVALID")], [])
    return graph


def test_humble_is_recognised_by_its_discovery_message() -> None:
    graph = humble_graph()
    (found,) = peers.problems_of("read", "/old", "std_msgs/msg/String", graph)
    assert "as ROS 2 Humble and older do" in found
    assert "ROS_DOMAIN_ID" in found
    assert peers.problems_of("read", "/new", "std_msgs/msg/String", graph) == []


@pytest.mark.parametrize(
    ("facts", "said"),
    [
        ({"node": "_CREATED_BY_BARE_DDS_APP_", "vendor": CYCLONE}, "uses Cyclone DDS without ROS"),
        ({"node": "_CREATED_BY_BARE_DDS_APP_", "vendor": b"\x01\x7f"}, "uses another DDS without"),
        ({"node": "_NODE_NAME_UNKNOWN_"}, "a node"),
        ({"node": "camera"}, "/fr3/camera"),
        ({"node": "_NODE_NAME_UNKNOWN_", "process": 7}, "a node of ROS 2 Humble or older"),
    ],
)
def test_ends_without_a_name_are_named_by_what_they_are(facts: dict[str, Any], said: str) -> None:
    assert said in peers.name_of(end(**facts), peers.old_participants(humble_graph()))


def test_doctor_counts_the_others_and_names_what_does_not_fit() -> None:
    alone = Graph({"rt/image": ([end("camera")], [end("view", process=2)])})
    fine = judge(peers.GraphSurvey.of(alone, alone))
    assert fine.verdict is Severity.OK
    assert fine.text.startswith("On the graph: 2 x Fast DDS.")
    graph = humble_graph()
    graph["rt/image"] = ([end("camera", qos=BEST_EFFORT)], [end("view", process=2)])
    graph["rq/fr3/doRequest"] = ([], [end("driver", vendor=CYCLONE, process=9)])
    found = judge(peers.GraphSurvey.of(graph, graph))
    assert found.verdict is Severity.WARNING
    for said in (
        "1 x Cyclone DDS",
        "4 x Fast DDS",
        "Its topics: /old.",
        "cannot be called: /fr3/do.",
        "/fr3/view gets nothing from /fr3/camera on /image",
    ):
        assert said in found.text
    for done in ("ROS_DOMAIN_ID", "RMW_IMPLEMENTATION", "quality of service"):
        assert done in found.hint


@pytest.mark.parametrize(
    ("last_change_s", "looks_after_s"),
    [(0.0, 3.5), (2.4, 3.5), (5.0, 6.0), (99.0, 12.0)],
    ids=["at once", "early", "busy", "never quiet"],
)
def test_doctor_looks_when_nothing_new_has_come_for_a_second(
    last_change_s: float, looks_after_s: float
) -> None:
    now_s = [0.0]

    def sleep(duration_s: float) -> None:
        now_s[0] += duration_s

    wait_settled(lambda: min(now_s[0], last_change_s), lambda: now_s[0], sleep)
    assert now_s[0] == pytest.approx(looks_after_s, abs=0.45)
