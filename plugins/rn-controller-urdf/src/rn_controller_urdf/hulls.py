"""Convex hulls of meshes, as collision shapes whose distances take microseconds, and the surfaces
that decide where hulls are too close.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from roboneuron import ConfigurationError, RobotProfile, mesh_file

if TYPE_CHECKING:
    import pinocchio

MOST_VERTICES = 512
"""Bounds the time of one distance; hulls of links of public arms lack 1 to 3 mm with it."""
MOST_TRIANGLES = 5000
"""Of a mesh whose surface is compared, which takes 0.1 to 0.4 ms for two such; 5 ms for 50,000."""

_MOST_NEIGHBOURS = 255
"""Of a vertex of coal's hulls, which count them in a byte."""
_FLAT_M = 1e-4
"""Thickness of a mesh whose points lie in a plane, either way."""


def resolve_meshes(root: ET.Element, profile: RobotProfile) -> None:
    """Write the file of each mesh among the collision shapes into a description.

    Raises:
        ConfigurationError: names the files that are missing.
    """
    missing: list[str] = []
    for mesh in (mesh for shape in root.iter("collision") for mesh in shape.iter("mesh")):
        name = mesh.get("filename", "")
        path = mesh_file(name, profile.mesh_folder)
        if path is None:
            missing.append(name)
        else:
            mesh.set("filename", str(path))
    if missing:
        raise missing_meshes(profile, missing)


def missing_meshes(profile: RobotProfile, missing: list[str]) -> ConfigurationError:
    """The error for meshes without a file."""
    more = f" and {len(set(missing)) - 1} more" if len(set(missing)) > 1 else ""
    return ConfigurationError(
        f"Robot {profile.name!r}: the mesh {missing[0]!r}{more} of its collision shapes has no "
        "file.",
        hint="Set mesh_folder of its profile to the folder of the description, or source the ROS "
        "package.",
    )


def replace_meshes(shapes: pinocchio.GeometryModel) -> dict[int, Any]:
    """Replace every mesh of a geometry model by a hull that contains it; returns the meshes by the
    index of their shape, without those whose surface is not known. A flat mesh, which has no hull,
    gets a thickness.
    """
    import coal  # type: ignore[import-untyped]  # heavy; comes with pinocchio

    meshes: dict[int, Any] = {}
    for index, shape in enumerate(shapes.geometryObjects):
        if not isinstance(shape.geometry, coal.BVHModelBase):
            continue
        mesh = shape.geometry
        if _is_whole(mesh):
            meshes[index] = mesh
        corners = np.array([mesh.vertex(i) for i in range(mesh.num_vertices)])
        spread = np.linalg.svd(corners - corners.mean(axis=0), compute_uv=False)
        if spread[-1] <= _FLAT_M * math.sqrt(len(corners)):  # qhull does not survive a plane
            thick = _FLAT_M * np.concatenate([np.eye(3), -np.eye(3)])
            corners = (corners[:, np.newaxis] + thick).reshape(-1, 3)
        shape.geometry = _bounded(corners)
    return meshes


def surface_distance(first: Any, at: pinocchio.SE3, second: Any, there: pinocchio.SE3) -> float:
    """Distance [m] of two shapes, of which meshes are their surfaces; at most 0 where they meet."""
    import coal  # heavy

    poses = [coal.Transform3s(pose.rotation, pose.translation) for pose in (at, there)]
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    return float(coal.distance(first, poses[0], second, poses[1], request, result))


def _is_whole(mesh: Any) -> bool:
    """Triangles use every vertex. In a file of several parts they do not: coal 3.0.3 numbers the
    vertices of each part from 0, so that its surface is another one.
    """
    if mesh.num_tris > MOST_TRIANGLES:
        return True  # its surface is not compared
    used = {mesh.tri_indices(i)[corner] for i in range(mesh.num_tris) for corner in range(3)}
    return len(used) == int(mesh.num_vertices)


def _bounded(points: NDArray[np.float64]) -> Any:
    """A hull of at most `MOST_VERTICES` vertices around `points`: that of the farthest ones in
    evenly spread directions, thickened by what it lacks.
    """
    import coal  # heavy

    hull = _hull_of(points)
    if hull is not None:
        points = np.array(hull.points())
        if len(points) <= MOST_VERTICES:
            return hull
    small = None
    for count in (MOST_VERTICES, _MOST_NEIGHBOURS // 2):
        chosen = np.unique(np.argmax(points @ _directions(count).T, axis=0))
        if (small := _hull_of(points[chosen])) is not None:
            break
    assert small is not None
    here, there, tip = coal.Transform3s(), coal.Transform3s(), coal.Sphere(1e-9)
    lacking_m = 0.0
    for point in np.delete(points, chosen, axis=0):
        there.setTranslation(point)
        found = coal.DistanceResult()
        coal.distance(small, here, tip, there, coal.DistanceRequest(), found)
        lacking_m = max(lacking_m, found.min_distance)
    small.setSweptSphereRadius(lacking_m + 1e-6)
    return small


def _hull_of(points: NDArray[np.float64]) -> Any:
    """The hull; None if one of its vertices has more neighbours than coal counts, as on a disc."""
    import coal  # heavy

    kept = coal.StdVec_Vec3s()
    for point in points:
        kept.append(point)
    try:
        return coal.Convex.convexHull(kept, False, "Qt")
    except RuntimeError:
        if len(points) <= _MOST_NEIGHBOURS:
            raise
        return None


def _directions(count: int) -> NDArray[np.float64]:
    """Unit vectors (count, 3), evenly spread. Source: the Fibonacci lattice on a sphere."""
    rank = np.arange(count) + 0.5
    height, turn = 1.0 - 2.0 * rank / count, rank * math.pi * (1.0 + math.sqrt(5.0))
    width = np.sqrt(1.0 - height**2)
    return np.stack([width * np.cos(turn), width * np.sin(turn), height], axis=1)
