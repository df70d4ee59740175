"""Checker of joint commands that shares no code with the gate: limits from the robot's data sheet,
positions and distances from pinocchio with its description.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import coal  # type: ignore[import-untyped]
import numpy as np
import pinocchio
from numpy.typing import NDArray

F64 = NDArray[np.float64]
Box = tuple[tuple[float, ...], tuple[float, ...]]
EXACT = 1e-5
"""Relative tolerance for rounding, including durations in whole nanoseconds."""
BEND_M = 3e-3
"""Deviation of the TCP's path between two commands from the straight line that is limited: a chord
of 0.1 m, the longest step, in a circle of 0.4 m radius bends by 3 mm.
"""
BEND_SPEED = 1.1
"""Factor by which the TCP may exceed its average speed during a joint motion of constant
velocity.
"""
SAMPLES = 8
"""Number of postures checked along the path of a command."""


@dataclass(frozen=True, kw_only=True)
class ArmFacts:
    """One arm as its manufacturer and the test's configuration state it; SI units.

    Attributes:
        urdf, base_link, tcp_link, joints: the arm's part of the description.
        lower, upper, velocity, acceleration: joint limits, with the configured shares.
        velocity_bounds: lowest and highest joint velocity allowed at given positions.
        finger: the commanded joint of the gripper, and its travel.
        max_speed_m_s, max_turn_rad_s: limits of the TCP.
        workspace, min_height_m, zones: limits of the TCP's position, base frame.
        obstacles: boxes that no link may touch, by name.
        min_distance_m: between links, and to obstacles except for `tool_links`.
        tool_links: links that may approach obstacles without touching them.
        touching: pairs of links that always overlap.
        home: home positions of the joints.
    """

    urdf: str
    base_link: str
    tcp_link: str
    joints: tuple[str, ...]
    lower: F64
    upper: F64
    velocity: F64
    acceleration: F64
    velocity_bounds: Callable[[F64], tuple[F64, F64]]
    finger: tuple[str, float, float]
    max_speed_m_s: float
    max_turn_rad_s: float
    workspace: Box
    min_height_m: float
    zones: tuple[Box, ...]
    obstacles: dict[str, Box]
    min_distance_m: float
    tool_links: tuple[str, ...]
    touching: tuple[frozenset[str], ...]
    home: F64


@dataclass
class MotionJudge:
    """Follows the commands of one arm exactly, and records the limits that they break.

    Attributes:
        facts: facts of the arm.
        broken: violations by limit, one sentence each.
        greatest: largest used share of each limit.
    """

    facts: ArmFacts
    broken: dict[str, list[str]] = field(default_factory=dict)
    greatest: Counter[str] = field(default_factory=Counter)
    _finger: float = 0.0

    def __post_init__(self) -> None:
        facts = self.facts
        self._model = pinocchio.buildModelFromXML(facts.urdf)
        self._data = self._model.createData()
        self._tcp = self._model.getFrameId(facts.tcp_link)
        self._base = self._model.getFrameId(facts.base_link)
        self._places = [self._index(name) for name in facts.joints]
        self._fingers = [i for i in range(self._model.nq) if i not in self._places]
        self._shapes = self._shapes_of()
        self._contacts = self._shapes.createData()
        self._start, self._end = facts.home, facts.home
        self._sent_s, self._lasts_s = 0.0, 1.0

    # -- the arm that follows

    def place(self, now_s: float) -> F64:
        """Joint positions at a time."""
        share = min(1.0, max(0.0, (now_s - self._sent_s) / self._lasts_s))
        return np.asarray(self._start + (self._end - self._start) * share)

    def _velocity(self, now_s: float) -> F64:
        """Joint velocities at a time: after the end of its command an arm decelerates within its
        limit.
        """
        commanded = (self._end - self._start) / self._lasts_s
        over_s = max(0.0, now_s - self._sent_s - self._lasts_s)
        left = np.abs(commanded) - self.facts.acceleration * over_s
        return np.asarray(np.sign(commanded) * np.maximum(left, 0.0))

    def finger(self) -> float:
        """Position of the finger."""
        return self._finger

    def pose(self, position: F64) -> pinocchio.SE3:
        """TCP pose in the base frame."""
        pinocchio.framesForwardKinematics(self._model, self._data, self._full(position))
        return self._data.oMf[self._base].actInv(self._data.oMf[self._tcp])

    def hold(self, names: Sequence[str], position: F64, now_s: float) -> None:
        """Hold the arm at its measured position."""
        here = self.place(now_s)
        moved = np.abs(self._ordered(names, position) - here).max()
        self._demand("hold", moved <= EXACT, f"a hold moves a joint by {moved:g}")
        self._start, self._end, self._sent_s, self._lasts_s = here, here, now_s, 1.0

    def command(self, names: Sequence[str], position: F64, lasts_s: float, now_s: float) -> None:
        """Check a command, then follow it."""
        facts = self.facts
        start, end = self.place(now_s), self._ordered(names, position)
        before = self._velocity(now_s)
        velocity = (end - start) / lasts_s
        if not (np.isfinite(end).all() and np.isfinite(lasts_s) and lasts_s > 0.0):
            self._demand("finite", False, f"{end} in {lasts_s} s")
            return
        self._demand(
            "position",
            bool((end <= facts.upper + EXACT).all() and (end >= facts.lower - EXACT).all()),
            f"joints at {end}",
        )
        self._bounded("velocity", np.abs(velocity) / facts.velocity)
        lowest, highest = facts.velocity_bounds(end)
        near = velocity - highest if (velocity - highest).max() > 0.0 else lowest - velocity
        self._demand("braking", near.max() <= 2e-5, f"{velocity} at {end}, too near to a limit")
        change = np.abs(velocity - before) / facts.acceleration
        self._bounded("acceleration", change / max(now_s - self._sent_s, 1e-9))
        self._judge_path(start, end, lasts_s)
        if facts.finger[0] in names:
            self._finger = float(position[list(names).index(facts.finger[0])])
            low, high = facts.finger[1:]
            self._demand("gripper", low <= self._finger <= high, f"finger at {self._finger}")
        self._start, self._end, self._sent_s, self._lasts_s = start, end, now_s, lasts_s

    def _judge_path(self, start: F64, end: F64, lasts_s: float) -> None:
        facts = self.facts
        shares = np.linspace(0.0, 1.0, SAMPLES + 1)
        postures = [start + (end - start) * share for share in shares]
        poses = [self.pose(posture) for posture in postures]
        points = np.array([pose.translation for pose in poses])
        chord_m = float(np.linalg.norm(points[-1] - points[0]))
        turn_rad = _angle(poses[0], poses[-1])
        self._bounded("speed", chord_m / lasts_s / facts.max_speed_m_s)
        self._bounded("speed", turn_rad / lasts_s / facts.max_turn_rad_s)
        steps_m = np.linalg.norm(np.diff(points, axis=0), axis=1)
        fastest = float(steps_m.max()) * SAMPLES / lasts_s / facts.max_speed_m_s
        self._demand("speed", fastest <= BEND_SPEED, f"the TCP is {fastest:.3f} times too fast")
        deep_m = max(_outside_m(point, facts.workspace) for point in points)
        self._demand("workspace", deep_m <= BEND_M, f"the TCP is {deep_m:.4f} m outside")
        low_m = facts.min_height_m - float(points[:, 2].min())
        self._demand("height", low_m <= BEND_M, f"the TCP is {low_m:.4f} m too low")
        for zone in facts.zones:
            deep_m = max(-_outside_m(point, zone) for point in points)
            self._demand("zone", deep_m <= BEND_M, f"the TCP is {deep_m:.4f} m in {zone}")
        first, last = self._distances(start), self._distances(end)
        for pair, distance_m in last.items():
            least_m = self._least_m(pair)
            is_worse = distance_m < least_m - 1e-6 and distance_m <= first[pair]
            self._demand("collision", not is_worse, f"{pair} are {distance_m:.4f} m apart")
        for posture in postures[2:-1:3]:
            for pair, distance_m in self._distances(posture).items():
                self._demand("collision", distance_m >= 0.0, f"{pair} overlap on the way")

    def _bounded(self, limit: str, shares: F64 | float) -> None:
        share = float(np.max(shares))
        self.greatest[limit] = max(self.greatest[limit], share)  # type: ignore[assignment]
        self._demand(limit, share <= 1.0 + EXACT, f"{share:.6f} of the limit")

    def _demand(self, limit: str, is_kept: bool, otherwise: str) -> None:
        if not is_kept:
            self.broken.setdefault(limit, []).append(otherwise)

    # -- the description

    def _index(self, joint: str) -> int:
        return int(self._model.joints[self._model.getJointId(joint)].idx_q)

    def _ordered(self, names: Sequence[str], position: F64) -> F64:
        given = dict(zip(names, np.asarray(position).tolist(), strict=True))
        return np.array([given[name] for name in self.facts.joints])

    def _full(self, position: F64) -> F64:
        full = np.zeros(self._model.nq)
        full[self._places] = position
        full[self._fingers] = self._finger
        return full

    def _shapes_of(self) -> pinocchio.GeometryModel:
        """The collision shapes, and the pairs that could touch."""
        facts, model = self.facts, self._model
        shapes = pinocchio.buildGeomFromUrdfString(
            model, facts.urdf, pinocchio.GeometryType.COLLISION
        )
        pinocchio.framesForwardKinematics(model, self._data, np.zeros(model.nq))
        base = self._data.oMf[self._base].copy()
        self._links = [str(model.frames[s.parentFrame].name) for s in shapes.geometryObjects]
        own = len(self._links)
        for name, (low, high) in facts.obstacles.items():
            size = (np.array(high) - np.array(low)).tolist()
            centre = pinocchio.SE3(np.eye(3), (np.array(high) + np.array(low)) / 2.0)
            universe = model.getFrameId("universe")
            box = pinocchio.GeometryObject(name, 0, universe, base * centre, coal.Box(*size))
            shapes.addGeometryObject(box)
            self._links.append(name)
        for first in range(own):
            for second in range(first + 1, len(self._links)):
                if self._may_touch(shapes.geometryObjects, first, second):
                    shapes.addCollisionPair(pinocchio.CollisionPair(first, second))
        return shapes

    def _may_touch(self, shapes: Sequence[pinocchio.GeometryObject], a: int, b: int) -> bool:
        joints = [shapes[i].parentJoint for i in (a, b)]
        parents = [self._model.parents[joint] for joint in joints]
        if frozenset((self._links[a], self._links[b])) in self.facts.touching:
            return False
        if self._links[b] in self.facts.obstacles:
            return bool(joints[0] != 0)
        return joints[0] != joints[1] and parents[0] != joints[1] and parents[1] != joints[0]

    def _distances(self, position: F64) -> dict[tuple[str, str], float]:
        """Smallest distance of each pair of bodies [m]."""
        pinocchio.computeDistances(
            self._model, self._data, self._shapes, self._contacts, self._full(position)
        )
        found: dict[tuple[str, str], float] = {}
        for pair, result in zip(
            self._shapes.collisionPairs, self._contacts.distanceResults, strict=True
        ):
            names = (self._links[pair.first], self._links[pair.second])
            found[names] = min(found.get(names, np.inf), float(result.min_distance))
        return found

    def _least_m(self, pair: tuple[str, str]) -> float:
        is_tool = pair[0] in self.facts.tool_links and pair[1] in self.facts.obstacles
        return 0.0 if is_tool else self.facts.min_distance_m


def _outside_m(point: F64, box: Box) -> float:
    """Distance of a point from a box along the worst axis; negative inside."""
    return float(np.maximum(np.array(box[0]) - point, point - np.array(box[1])).max())


def _angle(first: pinocchio.SE3, second: pinocchio.SE3) -> float:
    return float(np.linalg.norm(pinocchio.log3(first.rotation.T @ second.rotation)))
