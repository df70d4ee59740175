"""Regions of a MoveIt constraint as boxes along the axes of their frame."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from roboneuron.contract.arrays import F64
from roboneuron.direct_path.places import check_rotation
from roboneuron.direct_path.planner_messages import BoundingVolume, Primitive
from roboneuron.direct_path.transforms import rotation_of
from roboneuron.errors import RefusedError

_SPHERE, _BOX, _CYLINDER, _CONE = 2, 1, 3, 4
"""shape_msgs/SolidPrimitive."""


def boxes_of(region: BoundingVolume, where: str) -> Iterator[tuple[F64, F64]]:
    """Yield the corners of axis-aligned boxes that contain the shapes of a BoundingVolume."""
    if region.meshes:
        raise RefusedError(
            f"{where}.constraint_region.meshes cannot be checked.", hint="Give primitives."
        )
    if len(region.primitives) != len(region.primitive_poses):
        raise RefusedError(
            f"{where}.constraint_region has {len(region.primitives)} primitives and "
            f"{len(region.primitive_poses)} primitive_poses."
        )
    for index, (shape, pose) in enumerate(
        zip(region.primitives, region.primitive_poses, strict=True)
    ):
        path = f"{where}.constraint_region.primitive_poses[{index}]"
        check_rotation(f"{path}.orientation", pose.orientation)
        half_m = np.abs(rotation_of(pose.orientation)) @ _half_m(
            shape, f"{where}.constraint_region"
        )
        centre_m = np.array([pose.position.x, pose.position.y, pose.position.z])
        yield centre_m - half_m, centre_m + half_m


def _half_m(shape: Primitive, where: str) -> F64:
    """Half of the edges of a box that contains a shape, along its own axes."""
    counts: Mapping[int, int] = {_BOX: 3, _SPHERE: 1, _CYLINDER: 2, _CONE: 2}
    sizes = [float(size) for size in shape.dimensions]
    if len(sizes) != counts.get(shape.type, -1) or min(sizes) < 0.0:
        raise RefusedError(
            f"{where}: dimensions {sizes} are not those of a primitive of type {shape.type}."
        )
    if shape.type == _BOX:
        return np.array(sizes) / 2.0
    if shape.type == _SPHERE:
        return np.full(3, sizes[0])
    height, radius = sizes
    return np.array([radius, radius, height / 2.0])
