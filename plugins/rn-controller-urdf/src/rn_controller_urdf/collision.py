"""Self-collision of a URDF arm, by pinocchio's collision library on the URDF's own collision shapes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from roboneuron.contract import RobotProfile
from roboneuron.errors import ConfigurationError

F64 = NDArray[np.float64]


class SelfCollision:
    """Tells which links touch; used from one thread.

    Links of one joint and of neighbouring joints are not compared, nor links that touch at the profile's home posture:
    their shapes overlap by construction. Joints that are not the arm's stay at zero, or at the limit next to it. Only
    boxes, cylinders, spheres and capsules count: meshes are refused.
    """

    def __init__(self, profile: RobotProfile, *, margin_m: float) -> None:
        """Build the shapes.

        Raises:
            ConfigurationError: the URDF has no collision shapes, meshes among them, or no pair that could touch.
        """
        import pinocchio  # heavy

        if "<mesh" in profile.urdf.partition("<collision")[2]:
            raise ConfigurationError(
                f"Robot {profile.name!r}: its description has meshes, self_collision needs boxes, cylinders or spheres."
            )
        self._pin: Any = pinocchio
        self._model = pinocchio.buildModelFromXML(profile.urdf)
        self._data = self._model.createData()
        self._shapes = pinocchio.buildGeomFromUrdfString(self._model, profile.urdf, pinocchio.GeometryType.COLLISION)
        self._rest: F64 = np.clip(
            pinocchio.neutral(self._model), self._model.lowerPositionLimit, self._model.upperPositionLimit
        )
        self._index: dict[tuple[str, ...], list[int]] = {}
        self._choose_pairs()
        self._contacts = self._new_contacts(margin_m)
        if profile.home_rad is not None:
            for pair in self._touching(self._full(profile.arm_joints, profile.home_rad)):
                self._shapes.removeCollisionPair(pair)
            self._contacts = self._new_contacts(margin_m)
        if not len(self._shapes.collisionPairs):
            raise ConfigurationError(
                f"Robot {profile.name!r}: no two links of its description have collision shapes that could touch."
            )

    @property
    def pairs(self) -> int:
        """How many pairs of shapes are compared."""
        return len(self._shapes.collisionPairs)

    def contact(self, names: tuple[str, ...], position: F64) -> str:
        """ "link and link" for the first two that touch with the joints `names` at `position` (n,); empty for none."""
        full = self._full(names, position)
        if not self._pin.computeCollisions(self._model, self._data, self._shapes, self._contacts, full, True):
            return ""
        pair = self._touched()[0]
        return f"{self._link(pair.first)} and {self._link(pair.second)}"

    def _new_contacts(self, margin_m: float) -> Any:
        contacts = self._shapes.createData()
        for request in contacts.collisionRequests:
            request.security_margin = margin_m
        return contacts

    def _touching(self, full: F64) -> list[Any]:
        self._pin.computeCollisions(self._model, self._data, self._shapes, self._contacts, full, False)
        return self._touched()

    def _touched(self) -> list[Any]:
        """Pairs found by the last call of computeCollisions; copies, since removing one moves the others."""
        return [
            self._pin.CollisionPair(pair.first, pair.second)
            for pair, result in zip(self._shapes.collisionPairs, self._contacts.collisionResults, strict=True)
            if result.isCollision()
        ]

    def _choose_pairs(self) -> None:
        shapes, parents = self._shapes.geometryObjects, self._model.parents
        for first, one in enumerate(shapes):
            for second in range(first + 1, len(shapes)):
                a, b = one.parentJoint, shapes[second].parentJoint
                if a != b and parents[a] != b and parents[b] != a and parents[a] != parents[b]:
                    self._shapes.addCollisionPair(self._pin.CollisionPair(first, second))

    def _full(self, names: tuple[str, ...], position: F64) -> F64:
        if names not in self._index:
            self._index[names] = [int(self._model.joints[self._model.getJointId(name)].idx_q) for name in names]
        full = self._rest.copy()
        full[self._index[names]] = position
        return full

    def _link(self, shape: int) -> str:
        return str(self._model.frames[self._shapes.geometryObjects[shape].parentFrame].name)
