"""Distances of a URDF robot's links to each other and to obstacles, computed by coal on the URDF's
collision shapes.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rn_controller_urdf.hulls import MOST_TRIANGLES, surface_distance
from rn_controller_urdf.shapes import LinkShapes
from roboneuron import (
    ArmProfile,
    CollisionProfile,
    ConfigurationError,
    JointSample,
    Proximity,
    RobotProfile,
)

if TYPE_CHECKING:
    import pinocchio

F64 = NDArray[np.float64]

_TOGETHER_M, _HOLLOW_M, _POSTURES = 0.025, 0.05, 200
"""Distances between which hulls of neighbouring links stay in all of so many postures. Measured on
UR5, UR10, Z1 and SO-101, whose planners leave out the same pairs.
"""
_TOUCH_M = 5e-4
"""Distance of tool links from obstacles, for rounding and the curvature of a path between two
checked postures.
"""


class _Required(NamedTuple):
    """Links of a pair of shapes, their least distance, and the shapes that decide below it."""

    names: tuple[str, str]
    least_m: float
    surfaces: tuple[Any, Any] | None


class CollisionModel(LinkShapes):
    """Finds links that are too close to each other or to an obstacle; used from one thread.

    One model contains all arms, so the distances between arms are checked like those between links.
    A mesh counts as its convex hull. Where hulls are too close, the surfaces of meshes of at most
    `MOST_TRIANGLES` decide, because a hull fills the hollow of an elbow: a link gets into one only
    by a posture at which surfaces meet, and paths are sampled more densely than their distance.

    Not compared, because they overlap by construction: links of one joint, links connected by a
    joint, fingers of one hand, shapes that touch at the profile's home posture, a base that stands
    on an obstacle, and hulls that are built so near to each other that they tell nothing: at most
    25 mm apart and 50 mm in each other at any joint positions. Joints missing in a sample are at
    rest, and mimic joints follow, as in `JointConfiguration`.
    """

    def __init__(self, profile: RobotProfile, collision: CollisionProfile) -> None:
        """Build the shapes.

        Raises:
            ConfigurationError: a mesh is missing or cannot be read, a tool link is unknown, or no
                pair could touch.
        """
        super().__init__(profile)
        self._collision = collision
        self._add_obstacles()
        self._check_tools()
        self._choose_pairs(ET.fromstring(profile.urdf), profile.arms)
        self._prepare()
        if profile.home_rad is not None:
            home = JointSample(names=profile.arm_joints, position=profile.home_rad)
            self._remove(self._distances_at(home) <= 0.0)
        if self._meshes:
            self._remove(self._are_built_together(profile))
        if not len(self._shapes.collisionPairs):
            raise ConfigurationError(
                f"Robot {profile.name!r}: no two links of its description have collision shapes "
                "that could touch.",
                hint="Set limits.collision = false to go without.",
            )

    @property
    def pairs(self) -> int:
        """Number of compared pairs of shapes."""
        return len(self._shapes.collisionPairs)

    def near(self, joints: JointSample) -> tuple[Proximity, ...]:
        """Every pair of bodies closer than allowed, each once with its smallest distance."""
        full = self._full(joints)
        if not self._pin.computeCollisions(
            self._model, self._data, self._shapes, self._contacts, full, True
        ):
            return ()
        self._measure(full)
        return tuple(self._nearest(only_close=True))

    def distances(self, joints: JointSample) -> tuple[Proximity, ...]:
        """Every pair of bodies that are compared, each once with its smallest distance, the nearest
        first. Takes ten times as long as `near`.
        """
        self._measure(self._full(joints))
        return tuple(sorted(self._nearest(only_close=False), key=lambda pair: pair.distance_m))

    def _add_obstacles(self) -> None:
        import coal  # type: ignore[import-untyped]  # heavy; comes with pinocchio

        for obstacle in self._collision.obstacles:
            size = (obstacle.upper_m - obstacle.lower_m).tolist()
            centre = self._pin.SE3(np.eye(3), (obstacle.upper_m + obstacle.lower_m) / 2.0)
            shape = self._pin.GeometryObject(
                obstacle.name,
                0,
                self._model.getFrameId("universe"),
                self._base * centre,
                coal.Box(*size),
            )
            self._shapes.addGeometryObject(shape)
            self._links.append(obstacle.name)

    def _check_tools(self) -> None:
        unknown = [name for name in self._collision.tool_links if name not in self._links]
        if unknown:
            raise ConfigurationError(
                f"The tool link {unknown[0]!r} has no collision shape in the robot description."
            )

    def _choose_pairs(self, root: ET.Element, arms: Sequence[ArmProfile]) -> None:
        neighbours = {
            frozenset((_link(j, "parent"), _link(j, "child"))) for j in root.findall("joint")
        }
        shapes, parents = self._shapes.geometryObjects, self._model.parents
        own = len(shapes) - len(self._collision.obstacles)
        arm_of = [""] * len(parents)
        for arm in arms:
            for joint in self._model.subtrees[self._model.getJointId(arm.joints[0])]:
                arm_of[joint] = arm.name
        for first in range(own):
            for second in range(first + 1, len(shapes)):
                a, b = shapes[first].parentJoint, shapes[second].parentJoint
                if second < own:
                    siblings = (
                        a > 0 and b > 0 and parents[a] == parents[b] and arm_of[a] == arm_of[b]
                    )
                    if (
                        a == b
                        or siblings
                        or frozenset((self._links[first], self._links[second])) in neighbours
                    ):
                        continue
                elif a == 0:  # fixed bodies cannot approach an obstacle
                    continue
                self._shapes.addCollisionPair(self._pin.CollisionPair(first, second))

    def _prepare(self) -> None:
        """Create scratch memory, and what is required of each pair."""
        self._contacts = self._shapes.createData()
        obstacles = {obstacle.name for obstacle in self._collision.obstacles}
        self._required: list[_Required] = []
        for pair, request in zip(
            self._shapes.collisionPairs, self._contacts.collisionRequests, strict=True
        ):
            is_tool = self._links[pair.first] in self._collision.tool_links
            is_close = is_tool and self._links[pair.second] in obstacles
            least_m = self._collision.min_distance_m
            least_m = min(_TOUCH_M, least_m) if is_close else least_m
            names = (self._links[pair.first], self._links[pair.second])
            self._required.append(_Required(names, least_m, self._surfaces(pair)))
            request.security_margin = least_m

    def _distances_at(self, joints: JointSample) -> F64:
        """The distance [m] of each pair; infinite for obstacles, which are always compared."""
        self._measure(self._full(joints))
        own = len(self._links) - len(self._collision.obstacles)
        return np.array(
            [
                found.min_distance if pair.second < own else np.inf
                for pair, found in zip(
                    self._shapes.collisionPairs, self._contacts.distanceResults, strict=True
                )
            ]
        )

    def _are_built_together(self, profile: RobotProfile) -> NDArray[np.bool_]:
        """True for pairs that are near each other in all of many postures, and nowhere deeper in
        each other than hulls reach into the hollows of links.
        """
        kinds, rng = profile.kinds, np.random.default_rng(0)
        names = kinds.moving
        widest = np.array([1.0 if name in kinds.prismatic else math.pi for name in names])
        lower, upper = np.array([kinds.limits(name) for name in names]).reshape(-1, 2).T
        low = np.maximum(lower, np.minimum(-widest, upper - widest))
        high = np.minimum(upper, np.maximum(widest, lower + widest))
        found = [
            self._distances_at(JointSample(names=names, position=rng.uniform(low, high)))
            for _ in range(_POSTURES)
        ]
        farthest: F64 = np.max(found, axis=0)
        deepest: F64 = np.min(found, axis=0)
        return np.logical_and(farthest <= _TOGETHER_M, deepest >= -_HOLLOW_M)

    def _remove(self, is_left_out: NDArray[np.bool_]) -> None:
        """Compare these pairs no longer."""
        pairs = [
            self._pin.CollisionPair(pair.first, pair.second)  # to remove one moves others
            for pair, is_out in zip(self._shapes.collisionPairs, is_left_out, strict=True)
            if is_out
        ]
        for pair in pairs:
            self._shapes.removeCollisionPair(pair)
        self._prepare()

    def _measure(self, full: F64) -> None:
        self._pin.computeDistances(self._model, self._data, self._shapes, self._contacts, full)

    def _nearest(self, *, only_close: bool) -> Iterable[Proximity]:
        """The smallest distance of each pair of bodies in the last `_measure`; `only_close`: only
        of those that are closer than allowed.
        """
        nearest: dict[tuple[str, str], Proximity] = {}
        for index, ((names, least_m, _), found) in enumerate(
            zip(self._required, self._contacts.distanceResults, strict=True)
        ):
            distance_m = found.min_distance
            if distance_m < least_m:
                distance_m = self._apart(index, distance_m)
            if only_close and distance_m >= least_m:
                continue
            if names not in nearest or distance_m < nearest[names].distance_m:
                nearest[names] = Proximity(
                    first=names[0], second=names[1], distance_m=distance_m, least_m=least_m
                )
        return nearest.values()

    def _surfaces(self, pair: pinocchio.CollisionPair) -> tuple[Any, Any] | None:
        """The shapes of a pair with meshes as their surfaces; None without a mesh, and if one has
        too many triangles.
        """
        both = (pair.first, pair.second)
        meshes = [self._meshes[index] for index in both if index in self._meshes]
        if not meshes or max(mesh.num_tris for mesh in meshes) > MOST_TRIANGLES:
            return None
        shapes = self._shapes.geometryObjects
        first, second = (self._meshes.get(index, shapes[index].geometry) for index in both)
        return first, second

    def _apart(self, index: int, hull_m: float) -> float:
        """Distance of the surfaces of a pair whose hulls are `hull_m` apart; that where they meet,
        and without surfaces.
        """
        surfaces = self._required[index].surfaces
        if surfaces is None:
            return hull_m
        pair, poses = self._shapes.collisionPairs[index], self._contacts.oMg
        apart_m = surface_distance(surfaces[0], poses[pair.first], surfaces[1], poses[pair.second])
        return apart_m if apart_m > 0.0 else hull_m


def _link(joint: ET.Element, role: str) -> str:
    element = joint.find(role)
    return "" if element is None else element.get("link", "")
