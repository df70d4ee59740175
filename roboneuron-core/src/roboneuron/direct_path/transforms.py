"""Transforms between frames, from the topics `/tf` and `/tf_static` at the time of the request.

A frame has one parent; the frames of a robot form one tree. Source: REP 105, and the documentation
of tf2.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from roboneuron.contract.arrays import F64
from roboneuron.direct_path.fields import load_type
from roboneuron.direct_path.message_types import (
    Quaternion,
    TransformMessage,
    TransformParts,
    TransformStamped,
    Vector,
)
from roboneuron.errors import NotReadyError, StateError
from roboneuron.server.host import Host

TYPE = "tf2_msgs/msg/TFMessage"
STATIC = "_static"
"""Suffix of the topic with static transforms."""
_DEPTH = 100
"""Queue depth: several nodes may each publish a static transform, and all arrive at once."""
_POLL_S = 0.02
_MOST_FRAMES = 2000
_AHEAD_S = 5.0
"""Largest lead of a stamp: publishers stamp ahead by the validity of a transform; more means
another clock.
"""
_LEAST_NORM, _GREATEST_NORM = 0.99, 1.01


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Transform:
    """Pose of a frame in another: p_target = rotation @ p_source + translation.

    Attributes:
        rotation: float64 (3, 3).
        translation_m: float64 (3,).
        age_s: age of the oldest stamp in the chain; 0 if all are static.
        frames: from the source to the target.
    """

    rotation: F64
    translation_m: F64
    age_s: float = 0.0
    frames: tuple[str, ...] = ()

    @property
    def quaternion_xyzw(self) -> F64:
        """The rotation, float64 (4,), w >= 0. Source: Shepperd 1978."""
        r = self.rotation
        trace = float(np.trace(r))
        squares = np.array([r[0, 0], r[1, 1], r[2, 2], trace])
        largest = int(np.argmax(squares))
        q = np.empty(4)
        if largest == 3:
            q[:3] = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
            q[3] = 1.0 + trace
        else:
            i, j, k = largest, (largest + 1) % 3, (largest + 2) % 3
            q[i] = 1.0 + 2.0 * r[i, i] - trace
            q[j], q[k] = r[j, i] + r[i, j], r[k, i] + r[i, k]
            q[3] = r[k, j] - r[j, k]
        q /= np.linalg.norm(q)
        return q if q[3] >= 0.0 else -q


def rotation_of(quaternion: Quaternion) -> F64:
    """Return the rotation matrix, float64 (3, 3), of a quaternion message with a length of
    about 1.
    """
    x, y, z, w = np.array([quaternion.x, quaternion.y, quaternion.z, quaternion.w]) / math.hypot(
        quaternion.x, quaternion.y, quaternion.z, quaternion.w
    )
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class _Edge:
    """Pose of a frame in its parent; `stamp_s` is None for a static one."""

    parent: str
    rotation: F64
    translation_m: F64
    stamp_s: float | None


class FrameTree:
    """Frames, each with the newest transform to its parent. Usable from any thread."""

    def __init__(self) -> None:
        self._edges: dict[str, _Edge] = {}
        self._faults: dict[str, str] = {}

    def add(self, transforms: Iterable[TransformStamped], *, is_static: bool) -> None:
        """Add TransformStamped messages; an invalid one is stored as a fault of its frame."""
        for message in transforms:
            child, parent = (
                name.removeprefix("/") for name in (message.child_frame_id, message.header.frame_id)
            )
            if len(self._edges) >= _MOST_FRAMES and child not in self._edges:
                continue
            stamp = message.header.stamp
            edge = _Edge(
                parent=parent,
                rotation=np.eye(3),
                translation_m=_vector(message.transform.translation),
                stamp_s=None if is_static else stamp.sec + stamp.nanosec * 1e-9,
            )
            fault = _fault(child, parent, message.transform) or self._other_parent(child, edge)
            if fault:
                self._faults[child] = fault
                continue
            self._edges[child] = _Edge(
                parent=parent,
                rotation=rotation_of(message.transform.rotation),
                translation_m=edge.translation_m,
                stamp_s=edge.stamp_s,
            )

    def find(self, target: str, source: str, now_s: float, max_age_s: float) -> Transform:
        """Return the transform from `source` to `target`.

        Args:
            target, source: frames.
            now_s: ROS time [s].
            max_age_s: oldest stamp that is used.

        Raises:
            NotReadyError: a frame is unknown, the frames are in unconnected trees or form a cycle,
                or a transform is old or invalid.
        """
        edges = dict(self._edges)
        known = edges.keys() | {edge.parent for edge in edges.values()}
        for frame in (target, source):
            if frame in self._faults:
                raise NotReadyError(self._faults[frame])
        for frame in (target, source):
            if frame not in known:
                listed = ", ".join(sorted(known)[:20]) or "none"
                raise NotReadyError(f"The frame {frame[:60]!r} is unknown; known are: {listed}.")
        up, down = self._to_root(edges, source), self._to_root(edges, target)
        if up[-1] != down[-1]:
            raise NotReadyError(
                f"{source!r} and {target!r} are in trees that are not connected, of {up[-1]!r} and "
                f"of {down[-1]!r}.",
                hint="What publishes the transform between them is missing.",
            )
        while len(up) > 1 and len(down) > 1 and up[-2] == down[-2]:
            up.pop()
            down.pop()
        age_s = max(
            [0.0, *(self._age_s(edges[f], f, now_s, max_age_s) for f in (*up[:-1], *down[:-1]))]
        )
        from_source, from_target = _chain(edges, up), _chain(edges, down)
        turn = from_target[0].T
        return Transform(
            rotation=turn @ from_source[0],
            translation_m=turn @ (from_source[1] - from_target[1]),
            age_s=age_s,
            frames=(*up, *down[-2::-1]),
        )

    def _to_root(self, edges: dict[str, _Edge], frame: str) -> list[str]:
        way = [frame]
        while way[-1] in edges:
            if way[-1] in self._faults:
                raise NotReadyError(self._faults[way[-1]])
            parent = edges[way[-1]].parent
            if parent in way:
                circle = [*way[way.index(parent) :], parent]
                raise NotReadyError(f"The frames go in a circle: {' -> '.join(circle)}.")
            way.append(parent)
        if way[-1] in self._faults:
            raise NotReadyError(self._faults[way[-1]])
        return way

    def _other_parent(self, child: str, edge: _Edge) -> str:
        old = self._edges.get(child)
        if old is None or old.parent == edge.parent:
            return ""
        return f"The frame {child!r} has two parents, {old.parent!r} and {edge.parent!r}."

    def _age_s(self, edge: _Edge, frame: str, now_s: float, max_age_s: float) -> float:
        if edge.stamp_s is None:
            return 0.0
        age_s = now_s - edge.stamp_s
        if age_s > max_age_s or age_s < -_AHEAD_S:
            when = f"{age_s:.2f} s old" if age_s > 0 else f"{-age_s:.2f} s ahead of the clock here"
            raise NotReadyError(
                f"The transform from {frame!r} to {edge.parent!r} is {when}, allowed is "
                f"{max_age_s:g} s.",
                hint="Look at what publishes it, and at the clocks of the machines.",
            )
        return max(0.0, age_s)


def find_transform(
    host: Host,
    topic: str,
    target: str,
    source: str,
    *,
    max_age_s: float,
    timeout_s: float,
    halt: threading.Event | None = None,
) -> Transform:
    """Return the transform from `source` to `target`, from the topics published now; blocks until
    it is available.

    Args:
        host: provides the ROS node.
        topic: topic of moving transforms; static ones are on the same name with "_static".
        target, source: frames.
        max_age_s: oldest stamp that is used.
        timeout_s: longest wait.
        halt: set when the call is cancelled.

    Raises:
        NotReadyError: as `FrameTree.find`, after the timeout.
        ConfigurationError: the type of the topics is not known.
        StateError: `halt` was set.
    """
    tree, deadline_s = FrameTree(), time.monotonic() + timeout_s
    subscribed: dict[str, tuple[frozenset[object], Callable[[], None]]] = {}
    ros_type = load_type(TYPE)
    try:
        while True:
            for name, is_static in ((topic, False), (topic + STATIC, True)):
                _follow(host, ros_type, name, is_static, tree, subscribed)
            try:
                return tree.find(target, source, time.time(), max_age_s)
            except NotReadyError:
                if time.monotonic() >= deadline_s:
                    raise
            if halt is not None and halt.is_set():
                raise StateError("The call was cancelled.")
            time.sleep(_POLL_S)
    finally:
        for _, unsubscribe in subscribed.values():
            unsubscribe()


def _follow(
    host: Host,
    ros_type: type[TransformMessage],
    topic: str,
    is_static: bool,
    tree: FrameTree,
    subscribed: dict[str, tuple[frozenset[object], Callable[[], None]]],
) -> None:
    """Subscribe with the QoS of the present publishers; kept messages arrive at once."""
    infos = host.graph.publishers(topic)
    offered: frozenset[object] = frozenset(
        (str(info.endpoint_gid), info.qos_profile.durability) for info in infos
    )
    before = subscribed.get(topic)
    if not infos or (before is not None and before[0] == offered):
        return
    if before is not None:
        before[1]()

    def take(message: TransformMessage) -> None:
        tree.add(message.transforms, is_static=is_static)

    end = host.subscribe(ros_type, topic, take, depth=_DEPTH, latched=is_static)
    subscribed[topic] = offered, end


def _fault(child: str, parent: str, transform: TransformParts) -> str:
    """Reason why a message is not a valid transform; empty if it is."""
    if not child or not parent or child == parent:
        return f"The frame {child!r} has the parent {parent!r}: that is no transform."
    q = transform.rotation
    norm = math.hypot(q.x, q.y, q.z, q.w)
    is_place = bool(np.isfinite(_vector(transform.translation)).all())
    if not (is_place and _LEAST_NORM <= norm <= _GREATEST_NORM):
        return (
            f"What is published from {child!r} to {parent!r} is no transform: not finite, or "
            f"the quaternion has the length {norm:.3g}."
        )
    return ""


def _vector(message: Vector) -> F64:
    return np.array([message.x, message.y, message.z], dtype=np.float64)


def _chain(edges: dict[str, _Edge], frames: list[str]) -> tuple[F64, F64]:
    """Rotation and translation of the first frame in the last."""
    rotation, translation_m = np.eye(3), np.zeros(3)
    for frame in frames[:-1]:
        edge = edges[frame]
        rotation = edge.rotation @ rotation
        translation_m = edge.rotation @ translation_m + edge.translation_m
    return rotation, translation_m
