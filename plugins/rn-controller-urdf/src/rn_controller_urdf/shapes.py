"""The collision shapes of a URDF robot's links, and the boxes that its links take."""

from __future__ import annotations

import itertools
import math
import xml.etree.ElementTree as ET
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rn_controller_urdf.chain import one_coordinate
from rn_controller_urdf.hulls import replace_meshes, resolve_meshes
from roboneuron import (
    ConfigurationError,
    JointSample,
    LinkExtents,
    Pose,
    RobotProfile,
    UnsafeError,
)

if TYPE_CHECKING:
    from types import ModuleType

    import pinocchio

F64 = NDArray[np.float64]

HELD_M = 0.05
"""What a hand may hold is taken to reach so far around the TCP: its size is not known here."""
_OPEN = 0.98
"""From this opening on a hand holds nothing."""
_SIDES = 16
"""Of the prism around a cylinder: at most 2 % wider."""


class LinkShapes:
    """Collision shapes of all links in one model; used from one thread."""

    def __init__(self, profile: RobotProfile) -> None:
        """Build the shapes.

        Raises:
            ConfigurationError: a mesh is missing or cannot be read.
        """
        import pinocchio  # heavy

        root = ET.fromstring(profile.urdf)
        resolve_meshes(root, profile)
        self._pin: ModuleType = pinocchio
        urdf = one_coordinate(root)
        self._model = pinocchio.buildModelFromXML(urdf)
        self._data = self._model.createData()
        try:
            self._shapes = pinocchio.buildGeomFromUrdfString(
                self._model, urdf, pinocchio.GeometryType.COLLISION
            )
        except (ValueError, RuntimeError) as error:  # a file that holds no mesh
            raise ConfigurationError(
                f"Robot {profile.name!r}: its collision shapes cannot be read: {error}"
            ) from error
        self._meshes = replace_meshes(self._shapes)
        self._links = [
            str(self._model.frames[s.parentFrame].name) for s in self._shapes.geometryObjects
        ]
        self._base = self._place_base(profile.base_link)
        self._set_configuration(profile)

    def _place_base(self, base_link: str) -> pinocchio.SE3:
        """Pose of the base link in the model's own frame; obstacles are given in the base frame."""
        pin = self._pin
        frame = self._model.getFrameId(base_link, pin.FrameType.BODY)
        pin.framesForwardKinematics(self._model, self._data, pin.neutral(self._model))
        return self._data.oMf[frame].copy()

    def _set_configuration(self, profile: RobotProfile) -> None:
        """Find the coordinate of each joint."""
        moving = [name for name in profile.kinds.moving if self._model.existJointName(name)]
        coordinates = [self._model.joints[self._model.getJointId(name)].idx_q for name in moving]
        order = sorted(zip(coordinates, moving, strict=True))
        self._coordinates = [int(coordinate) for coordinate, _ in order]
        self._configuration = profile.kinds.configuration([name for _, name in order])
        self._neutral: F64 = self._pin.neutral(self._model)  # of joints with several coordinates
        self._is_whole = len(order) == self._model.nq

    def _full(self, joints: JointSample) -> F64:
        full = self._configuration(joints.names, np.asarray(joints.position, dtype=np.float64))
        if not np.isfinite(full).all():
            raise UnsafeError(
                f"A joint is not finite: {dict(zip(joints.names, joints.position, strict=False))}."
            )
        if self._is_whole:
            return full
        whole = self._neutral.copy()
        whole[self._coordinates] = full
        return whole


class LinkBoxes(LinkShapes):
    """Boxes around the moving links; used from one thread."""

    def __init__(self, profile: RobotProfile) -> None:
        """Build the shapes. Raises ConfigurationError as `LinkShapes`."""
        super().__init__(profile)
        self._arms = profile.each_arm
        points: dict[tuple[str, int], list[F64]] = {}
        for shape, link in zip(self._shapes.geometryObjects, self._links, strict=True):
            if shape.parentJoint:  # others do not move
                corners = _corners(shape.geometry)
                placed = corners @ shape.placement.rotation.T + shape.placement.translation
                points.setdefault((link, int(shape.parentJoint)), []).append(placed)
        self._points = {key: np.concatenate(parts) for key, parts in points.items()}

    def extents(self, joints: JointSample, poses: tuple[Pose, ...]) -> LinkExtents:
        """The boxes at a posture, whose TCP poses are known.

        Raises:
            UnsafeError: no moving link has a collision shape, or a joint is not finite.
        """
        if not self._points:
            raise UnsafeError("the links have no collision shapes that limits of the arm could use")
        self._pin.forwardKinematics(self._model, self._data, self._full(joints))
        names, lower, upper = [], [], []
        for (link, joint), points in self._points.items():
            placement = self._base.actInv(self._data.oMi[joint])
            there = points @ placement.rotation.T + placement.translation
            names.append(link)
            lower.append(there.min(axis=0))
            upper.append(there.max(axis=0))
        for arm, pose in zip(self._arms, poses, strict=True):
            opening = arm.opening_in(joints)
            if arm.gripper is not None and (opening is None or opening < _OPEN):
                names.append(f"what the {arm.name} hand holds".replace("  ", " "))
                lower.append(pose.position_m - HELD_M)
                upper.append(pose.position_m + HELD_M)
        return LinkExtents(names=tuple(names), lower_m=np.array(lower), upper_m=np.array(upper))


def _corners(geometry: Any) -> F64:
    """Points (n, 3) whose hull contains a shape, in its own frame."""
    import coal  # type: ignore[import-untyped]  # heavy; comes with pinocchio

    if isinstance(geometry, coal.ConvexBase):
        points, thick = np.array(geometry.points()), geometry.getSweptSphereRadius()
        if not thick:
            return points
        around = thick * np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
        return np.concatenate([points + offset for offset in around])
    if isinstance(geometry, coal.Cylinder):
        angles = np.arange(_SIDES) * 2 * math.pi / _SIDES
        radius = geometry.radius / math.cos(math.pi / _SIDES)
        ring = radius * np.stack([np.cos(angles), np.sin(angles), np.zeros(_SIDES)], axis=1)
        top = np.array([0.0, 0.0, geometry.halfLength])
        return np.concatenate([ring - top, ring + top])
    geometry.computeLocalAABB()
    box = geometry.aabb_local
    return np.array(list(itertools.product(*zip(box.min_, box.max_, strict=True))))
