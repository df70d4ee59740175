"""Collision shapes of a URDF as the sweep of public robots reads them: primitives, and meshes by
trimesh, compared by coal.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple, cast

import coal  # type: ignore[import-untyped]
import numpy as np
import trimesh

from rn_controller_urdf.hulls import MOST_TRIANGLES
from rn_testing.robot_judge import JudgedRobot, rotation
from roboneuron import F64, mesh_file

LEAST_M = 0.01


class JudgedShapes:
    """Distances between the collision shapes of links."""

    def __init__(self, urdf: str, folder: str, rest: Mapping[str, float]) -> None:
        self.robot, self._rest = JudgedRobot(urdf), rest
        self._left_out: dict[tuple[str, str], np.ndarray] = {}
        self._shapes: dict[str, list[tuple[F64, Shape]]] = defaultdict(list)
        for link in ElementTree.fromstring(urdf).findall("link"):
            for shape in link.findall("collision"):
                origin, geometry = shape.find("origin"), shape.find("geometry")
                if geometry is None or len(geometry) == 0:
                    continue
                made = _shape(geometry[0], folder)
                self._shapes[link.get("name", "")].append((_pose(origin), made))

    def distance(self, one: str, other: str, positions: Mapping[str, float], root: str) -> float:
        """Distance of two links [m], without shapes that are built together; negative where they
        overlap.
        """
        found = self._each(one, other, positions, root)
        if (one, other) not in self._left_out:
            at_rest = self._each(one, other, self._rest, root)
            self._left_out[one, other] = at_rest <= 0.0
        is_left_out = self._left_out[one, other]
        return math.inf if is_left_out.all() else float(found[~is_left_out].min())

    def leave_out_together(
        self, one: str, other: str, postures: list[dict[str, float]], root: str
    ) -> None:
        """Compare no longer what stays within 25 mm, and no deeper than 50 mm, in all postures."""
        found = np.array([self._each(one, other, posture, root) for posture in postures])
        self._left_out[one, other] |= (found.max(axis=0) <= 0.025) & (found.min(axis=0) >= -0.05)

    def _each(self, one: str, other: str, positions: Mapping[str, float], root: str) -> F64:
        poses = {name: self.robot.pose(name, positions, root) for name in (one, other)}
        return np.array(
            [
                _distance(first, poses[one] @ at, second, poses[other] @ there)
                for at, first in self._shapes[one]
                for there, second in self._shapes[other]
            ]
        )


class Shape(NamedTuple):
    """A convex shape, and the triangles that it stands for: itself for primitives, None for a mesh
    of many triangles.
    """

    convex: object
    surface: object | None
    is_mesh: bool


def _shape(element: ElementTree.Element, folder: str) -> Shape:
    made: object
    if element.tag == "mesh":
        return _mesh(mesh_file(element.get("filename", ""), folder), element.get("scale", "1 1 1"))
    if element.tag == "box":
        made = coal.Box(*_numbers(element.get("size", "")))
    elif element.tag == "sphere":
        made = coal.Sphere(float(element.get("radius", "0")))
    else:
        size = float(element.get("radius", "0")), float(element.get("length", "0"))
        made = coal.Cylinder(*size) if element.tag == "cylinder" else coal.Capsule(*size)
    return Shape(made, made, False)


def _mesh(path: Path | None, scale: str) -> Shape:
    loaded = cast("trimesh.Trimesh", trimesh.load(path, force="mesh"))
    points, surface = coal.StdVec_Vec3s(), coal.BVHModelOBBRSS()
    surface.beginModel(len(loaded.faces), len(loaded.vertices))
    for point in np.array(loaded.vertices) * _numbers(scale):
        points.append(point)
    surface.addVertices(np.array(loaded.vertices) * _numbers(scale))
    surface.addTriangles(np.array(loaded.faces))
    surface.endModel()
    is_small = len(loaded.faces) <= MOST_TRIANGLES
    return Shape(_hull(points), surface if is_small else None, True)


def _hull(points: coal.StdVec_Vec3s) -> object:
    """The convex hull of all points. Coal counts at most 255 neighbours of a vertex, and the middle
    of a disc may have more; moved by rounding errors ("QJ" of qhull) the points lie on no disc.
    """
    try:
        return coal.Convex.convexHull(points, False, "Qt")
    except RuntimeError:
        return coal.Convex.convexHull(points, False, "QJ")


def _distance(one: Shape, at: F64, other: Shape, there: F64) -> float:
    hull_m = _measured(one.convex, at, other.convex, there)
    if hull_m >= LEAST_M or not (one.is_mesh or other.is_mesh):
        return hull_m
    if one.surface is None or other.surface is None:
        return hull_m
    apart_m = _measured(one.surface, at, other.surface, there)
    return apart_m if apart_m > 0.0 else hull_m


def _measured(first: object, at: F64, second: object, there: F64) -> float:
    found = coal.DistanceResult()
    poses = [coal.Transform3s(pose[:3, :3], pose[:3, 3]) for pose in (at, there)]
    coal.distance(first, poses[0], second, poses[1], coal.DistanceRequest(), found)
    return float(found.min_distance)


def _pose(origin: ElementTree.Element | None) -> F64:
    pose = np.eye(4)
    if origin is not None:
        roll, pitch, yaw = _numbers(origin.get("rpy", "0 0 0"))
        x, y, z = np.eye(3)
        pose[:3, :3] = rotation(z, yaw) @ rotation(y, pitch) @ rotation(x, roll)
        pose[:3, 3] = _numbers(origin.get("xyz", "0 0 0"))
    return pose


def _numbers(text: str) -> F64:
    return np.array([float(word) for word in text.split()])
