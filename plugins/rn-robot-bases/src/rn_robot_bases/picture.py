"""An image of a drive: the platform rendered at several poses along its track."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from rn_robot_bases.platform import Platform
from rn_simulation.engine import EngineChoice, choose_engine
from rn_simulation.planar_motion import PlanarPose
from roboneuron import InvalidInputError

F64 = NDArray[np.float64]

_FLOOR_RGB = (233, 235, 238)
_GRID_RGB = (208, 212, 218)
_TRACK_RGB = (226, 96, 32)
_SMOOTHING = 2
_TILT_RAD = math.radians(35.0)
_VIEW_RAD = math.radians(30.0)
_MARGIN_M = 0.6


def draw_track(
    platform: Platform,
    poses: Sequence[PlanarPose],
    *,
    copies: int = 7,
    width: int = 640,
    height: int = 400,
    engine: EngineChoice = "auto",
) -> NDArray[np.uint8]:
    """Draw `poses` as a line on a floor with a grid of 1 m, and the platform at `copies` poses
    along it.

    Returns:
        uint8 (height, width, 3) RGB.

    Raises:
        InvalidInputError: there is no pose.
        ConfigurationError: the engine is not installed.
    """
    if not poses:
        raise InvalidInputError("A track without poses cannot be drawn.")
    points = np.array([(pose.x_m, pose.y_m) for pose in poses])
    view, projection = _camera(points, width / height)
    size = (width * _SMOOTHING, height * _SMOOTHING)
    canvas = Image.new("RGB", size, _FLOOR_RGB)
    pencil = ImageDraw.Draw(canvas)
    for line in _grid(points):
        pencil.line(_pixels(line, view, projection, size), fill=_GRID_RGB, width=_SMOOTHING)
    if len(points) > 1:
        pencil.line(
            _pixels(points, view, projection, size),
            fill=_TRACK_RGB,
            width=2 * _SMOOTHING,
            joint="curve",
        )
    if choose_engine(engine) == "mujoco":
        from rn_robot_bases.mujoco_picture import draw_robots  # heavy, and perhaps not installed
    else:
        from rn_robot_bases.pybullet_picture import draw_robots  # likewise
    robots, is_robot = draw_robots(platform, _spaced(poses, points, copies), view, projection, size)
    image = np.where(is_robot[:, :, None], robots, np.asarray(canvas))
    small = Image.fromarray(image.astype(np.uint8)).resize((width, height), Image.Resampling.BOX)
    return np.array(small, dtype=np.uint8)


def _camera(points: F64, aspect: float) -> tuple[F64, F64]:
    """View and projection matrices (4, 4) that show all points from the south, above."""
    low, high = points.min(axis=0) - _MARGIN_M, points.max(axis=0) + _MARGIN_M
    span_x, span_y = high - low
    target = np.array([*(low + high) / 2.0, 0.0])
    half_view = math.tan(_VIEW_RAD / 2.0)
    seen_height = max(span_y * math.cos(_TILT_RAD), span_x / aspect)
    distance = seen_height / 2.0 / half_view + span_y / 2.0 * math.sin(_TILT_RAD)
    away = np.array([0.0, -math.sin(_TILT_RAD), math.cos(_TILT_RAD)])
    up = np.array([0.0, math.cos(_TILT_RAD), math.sin(_TILT_RAD)])
    view = np.eye(4)
    view[:3, :3] = np.stack([np.array([1.0, 0.0, 0.0]), up, away])
    view[:3, 3] = -view[:3, :3] @ (target + distance * away)
    near, far = 0.1, distance + 20.0
    projection = np.zeros((4, 4))
    projection[0, 0], projection[1, 1] = 1.0 / half_view / aspect, 1.0 / half_view
    projection[2, 2:] = -(far + near) / (far - near), -2.0 * far * near / (far - near)
    projection[3, 2] = -1.0
    return view, projection


def _grid(points: F64) -> list[F64]:
    low, high = np.floor(points.min(axis=0)) - 4.0, np.ceil(points.max(axis=0)) + 4.0
    along_y = [np.array([(x, low[1]), (x, high[1])]) for x in np.arange(low[0], high[0] + 1.0)]
    along_x = [np.array([(low[0], y), (high[0], y)]) for y in np.arange(low[1], high[1] + 1.0)]
    return along_y + along_x


def _pixels(
    points: F64, view: F64, projection: F64, size: tuple[int, int]
) -> list[tuple[float, float]]:
    ground = np.column_stack([points, np.zeros(len(points)), np.ones(len(points))])
    clip = ground @ (projection @ view).T
    x, y = clip[:, 0] / clip[:, 3], clip[:, 1] / clip[:, 3]
    return list(
        zip(((x + 1.0) / 2.0 * size[0]).tolist(), ((1.0 - y) / 2.0 * size[1]).tolist(), strict=True)
    )


def _spaced(poses: Sequence[PlanarPose], points: F64, copies: int) -> list[PlanarPose]:
    """Select `copies` equidistant poses along the track, including the last one."""
    travelled = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    wanted = np.linspace(0.0, travelled[-1], copies + 1)[1:]
    return [poses[min(int(i), len(poses) - 1)] for i in np.searchsorted(travelled, wanted)]
