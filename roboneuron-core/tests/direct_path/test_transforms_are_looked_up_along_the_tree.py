"""Where a frame is in another, by transforms of a tree: composed, of an age, and none where none
is.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from roboneuron import Endpoint, NotReadyError, Obstacle, RefusedError
from roboneuron.direct_path.fields import filled, load_type
from roboneuron.direct_path.gate import Gate
from roboneuron.direct_path.places import to_frame
from roboneuron.direct_path.request import AllowedEndpoint
from roboneuron.direct_path.transforms import FrameTree, Transform, find_transform, rotation_of
from roboneuron.feature import GateRequest

NOW_S = 1000.0


def edge(
    parent: str,
    child: str,
    x: float = 0.0,
    y: float = 0.0,
    yaw: float = 0.0,
    age_s: float = 0.1,
    w: float | None = None,
) -> Any:
    """A TransformStamped: the child is at x, y in its parent, turned about z."""
    stamp_s = NOW_S - age_s
    turn = {"z": math.sin(yaw / 2), "w": math.cos(yaw / 2) if w is None else w}
    values = {
        "header": {
            "frame_id": parent,
            "stamp": {"sec": int(stamp_s), "nanosec": round(stamp_s % 1 * 1e9)},
        },
        "child_frame_id": child,
        "transform": {"translation": {"x": x, "y": y}, "rotation": turn},
    }
    return filled(load_type("geometry_msgs/msg/TransformStamped"), values)


def tree(*moving: Any, static: tuple[Any, ...] = ()) -> FrameTree:
    made = FrameTree()
    made.add(static, is_static=True)
    made.add(moving, is_static=False)
    return made


def find(made: FrameTree, target: str, source: str, max_age_s: float = 1.0) -> Transform:
    return made.find(target, source, NOW_S, max_age_s)


def test_a_chain_is_composed_upwards_and_downwards() -> None:
    made = tree(
        edge("map", "odom", x=1.0),
        edge("odom", "base", y=2.0, yaw=math.pi / 2, age_s=0.3),
        static=(edge("base", "camera", x=0.5, age_s=900.0),),
    )
    up = find(made, "map", "camera")
    assert up.translation_m == pytest.approx([1.0, 2.5, 0.0])
    assert up.quaternion_xyzw == pytest.approx([0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5)])
    assert up.age_s == pytest.approx(0.3)
    assert up.frames == ("camera", "base", "odom", "map")
    down = find(made, "camera", "map")
    assert down.rotation @ up.translation_m + down.translation_m == pytest.approx([0.0, 0.0, 0.0])
    assert down.frames == ("map", "odom", "base", "camera")


def test_two_branches_meet_where_they_part_and_not_at_the_root() -> None:
    made = tree(
        edge("map", "base", x=5.0, age_s=50.0),
        static=(edge("base", "camera", x=1.0), edge("base", "arm", y=1.0)),
    )
    found = find(made, "arm", "camera")
    assert found.translation_m == pytest.approx([1.0, -1.0, 0.0])
    assert found.frames == ("camera", "base", "arm")
    assert found.age_s == 0.0, "the old transform above them is not used"


def test_a_frame_is_at_home_in_itself() -> None:
    found = find(tree(edge("map", "base", x=5.0)), "base", "base")
    assert found.translation_m == pytest.approx([0.0, 0.0, 0.0])
    assert found.frames == ("base",)


@pytest.mark.parametrize(
    ("made", "told"),
    [
        (tree(edge("map", "base")), "'camera' is unknown; known are: base, map"),
        (tree(), "known are: none"),
        (
            tree(edge("map", "base"), edge("rig", "camera")),
            "trees that are not connected, of 'rig' and of 'map'",
        ),
        (
            tree(
                edge("base", "camera"),
                edge("arm", "base"),
                edge("base", "arm"),
                edge("map", "odom"),
            ),
            "circle: base -> arm -> base",
        ),
        (
            tree(edge("base", "camera", age_s=1.5), edge("map", "base")),
            "from 'camera' to 'base' is 1.50 s old, allowed is 1 s",
        ),
        (
            tree(edge("base", "camera", age_s=-20.0), edge("map", "base")),
            "20.00 s ahead of the clock here",
        ),
        (
            tree(edge("base", "camera"), edge("map", "base"), edge("odom", "base")),
            "'base' has two parents, 'map' and 'odom'",
        ),
        (tree(edge("map", "camera", w=0.5)), "the quaternion has the length 0.5"),
        (tree(edge("map", "camera", x=math.nan)), "not finite"),
        (tree(edge("map", "map"), edge("map", "camera", w=3.0)), "is no transform"),
    ],
)
def test_what_cannot_be_looked_up_is_named(made: FrameTree, told: str) -> None:
    with pytest.raises(NotReadyError, match=told):
        find(made, "map", "camera")


def test_the_newest_transform_counts_and_may_be_stamped_ahead() -> None:
    made = tree(edge("map", "base", x=1.0), edge("map", "base", x=2.0, age_s=-0.5))
    assert find(made, "map", "base").translation_m[0] == pytest.approx(2.0)
    assert find(made, "map", "base").age_s == 0.0


@given(st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4))
def test_a_rotation_is_the_same_as_its_quaternion(values: list[float]) -> None:
    norm = math.hypot(*values)
    if norm < 0.1:
        return
    q = np.array(values) / norm
    turn = rotation_of(SimpleNamespace(x=q[0], y=q[1], z=q[2], w=q[3]))
    back = Transform(rotation=turn, translation_m=np.zeros(3)).quaternion_xyzw
    assert back == pytest.approx(q if q[3] > 0.0 else -q, abs=1e-7) or abs(q[3]) < 1e-7


# Places


STAIRS = Obstacle(name="stairs", lower_m=np.array([2, -1, -1]), upper_m=np.array([3, 1, 1]))
GOAL = Endpoint(
    name="goal",
    kind="publish",
    topic="goal",
    type="geometry_msgs/msg/PoseStamped",
    summary="",
    bounds={"pose.position.x": (-1.0, 3.0)},
    frame="map",
    zones=(
        Obstacle(name="stairs", lower_m=np.array([2.0, -1, -1]), upper_m=np.array([3.0, 1, 1])),
    ),
)


def pose(x: float, frame: str, kind: str = "PoseStamped") -> Any:
    point = {"x": x}
    place = {"point": point} if kind == "PointStamped" else {"pose": {"position": point}}
    if kind == "PoseStamped":
        place["pose"]["orientation"] = {"w": 1.0}  # type: ignore[dict-item]
    return filled(load_type(f"geometry_msgs/msg/{kind}"), {"header": {"frame_id": frame}, **place})


def looked_up(target: str, source: str) -> Transform:
    """The base is 1 m along x of the map, and looks along y."""
    return find(tree(edge("map", "base", x=1.0, yaw=math.pi / 2)), target, source)


def test_a_pose_is_moved_into_the_frame_of_its_limits() -> None:
    message = pose(2.0, "base")
    changes = to_frame(GOAL, message, looked_up)
    assert message.header.frame_id == "map"
    assert message.pose.position.x == pytest.approx(1.0)
    assert message.pose.position.y == pytest.approx(2.0)
    assert message.pose.orientation.z == pytest.approx(math.sqrt(0.5))
    assert [(c.path, round(c.asked, 3), round(c.sent, 3)) for c in changes] == [
        ("pose.position.x", 2.0, 1.0),
        ("pose.position.y", 0.0, 2.0),
        ("pose.position.z", 0.0, 0.0),
    ]
    assert to_frame(GOAL, message, looked_up) == [], "once it is there it stays"


def test_a_point_is_moved_as_well() -> None:
    message = pose(1.0, "base", "PointStamped")
    to_frame(GOAL, message, looked_up)
    assert (message.point.x, message.point.y) == pytest.approx((1.0, 1.0))


@pytest.fixture
def ask(latch: Any, audit: Any, clock: Any) -> Callable[..., Any]:
    """Have a gate judge a pose."""
    entry = AllowedEndpoint(robot="base", endpoint=GOAL)
    gate = Gate(
        [entry], latch=latch, audit=audit, clock=clock.monotonic, transforms=looked_up
    )  # fmt: skip

    def make(message: Any) -> Any:
        return gate.check(
            GateRequest(
                who="agent",
                role="operator",
                tool="publish_goal",
                robot="base",
                endpoint="goal",
                messages=(message,),
                arguments={},
            )
        )

    return make


def test_bounds_and_zones_are_judged_where_the_place_is(ask: Callable[..., Any]) -> None:
    verdict = ask(pose(0.5, "base"))
    assert verdict.may_send
    assert verdict.clamped[1].sent == pytest.approx(0.5)
    assert ask(pose(5.0, "base")).may_send, "its x in the map is 1"
    with pytest.raises(RefusedError, match="in the zone 'stairs'"):
        ask(pose(2.5, "map"))
    with pytest.raises(RefusedError, match=r"header\.frame_id: The frame 'camera' is unknown"):
        ask(pose(0.0, "camera"))
    with pytest.raises(RefusedError, match="is '', expected 'map'"):
        ask(pose(0.0, ""))


# Listening


class Graph:
    """Who publishes, and what comes of it."""

    def __init__(self, *moving: Any, static: tuple[Any, ...] = ()) -> None:
        self.messages = {"/tf": moving, "/tf_static": static}
        self.latched: dict[str, bool] = {}
        self.ended: list[str] = []
        self.graph = self

    def publishers(self, topic: str) -> list[Any]:
        qos = SimpleNamespace(durability="kept")
        return [SimpleNamespace(endpoint_gid=b"1", qos_profile=qos)] if self.messages[topic] else []

    def subscribe(
        self, kind: Any, topic: str, take: Any, *, depth: int, latched: bool
    ) -> Callable[[], None]:
        self.latched[topic] = latched
        take(SimpleNamespace(transforms=self.messages[topic]))
        return lambda: self.ended.append(topic)


def listen(graph: Any, monkeypatch: pytest.MonkeyPatch) -> Transform:
    place = "roboneuron.direct_path.transforms"
    monkeypatch.setattr(f"{place}.load_type", lambda name: object)
    monkeypatch.setattr(f"{place}.time", SimpleNamespace(time=lambda: NOW_S, sleep=lambda s: None,
                        monotonic=iter(range(100)).__next__))  # fmt: skip
    return find_transform(graph, "/tf", "map", "camera", max_age_s=1.0, timeout_s=3.0)


def test_moving_and_kept_transforms_are_listened_to_until_the_answer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    graph = Graph(edge("map", "base", x=1.0), static=(edge("base", "camera", x=2.0),))
    assert listen(graph, monkeypatch).translation_m[0] == pytest.approx(3.0)
    assert graph.latched == {"/tf": False, "/tf_static": True}
    assert sorted(graph.ended) == ["/tf", "/tf_static"]


def test_a_transform_that_does_not_come_is_named_after_the_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    graph = Graph(edge("map", "base"))
    with pytest.raises(NotReadyError, match="'camera' is unknown; known are: base, map"):
        listen(graph, monkeypatch)
    assert graph.ended == ["/tf"]
