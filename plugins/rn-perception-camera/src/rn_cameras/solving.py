"""Intrinsics of a camera, and its pose in the frame of its mount, from pictures of a board.

OpenCV's `calibrateHandEye` is not used: the wheels of OpenCV 5.0 for Python lack it. The pose is
that of the least squared distances between seen and computed corners in all pictures.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from rn_cameras.board import Board, BoardCorners
from roboneuron import InvalidInputError

F64 = NDArray[np.float64]

LEAST_VIEWS = 8
"""Pictures from which intrinsics are measured, and poses of a hand that carries camera or board."""
_MANY_TIMES = 3.0
"""A picture whose error is so many times the median of all is left out: it was blurred, or the
board bent.
"""
_LEAST_TURN_RAD = math.radians(3.0)
"""Two pictures between which the hand turned less say nothing about orientation."""
_LEAST_APART_M = 0.01
"""Corners that are nearer to one line than this are no corners of a board."""
_LEAST_SPREAD = 0.1
"""Least ratio of the turns about a second axis to those about the first."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Optics:
    """A camera's measured lens.

    Attributes:
        size: width and height of its pictures [px].
        matrix: float64 (3, 3) [px], pixel centres at integers.
        distortion: k1, k2, p1, p2, k3 of OpenCV; zeros for pictures without distortion.
        deviation_px: float64 (4,), standard deviations of fx, fy, cx, cy [px]; zeros for a lens
            that somebody else has measured.
        error_px: root mean square distance of seen and computed corners; 0 likewise.
    """

    size: tuple[int, int]
    matrix: F64
    distortion: F64
    deviation_px: F64
    error_px: float = 0.0


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class MountedCamera:
    """A camera's measured pose.

    Attributes:
        T_mount_camera: float64 (4, 4), optical frame in the frame of its mount [m].
        error_px: root mean square distance of seen and computed corners in all pictures.
        deviation_m, deviation_rad: standard deviation of position and orientation along their
            longest axes, by how much the pictures disagree and by that of the lens. What is wrong
            in all pictures alike, such as the size of the board, does not show in it.
        views: number of pictures.
    """

    T_mount_camera: F64
    error_px: float
    deviation_m: float
    deviation_rad: float
    views: int


def measure_optics(
    board: Board, views: Mapping[str, BoardCorners], size: tuple[int, int]
) -> tuple[Optics, tuple[str, ...]]:
    """Measure the lens.

    Args:
        board: the board in the pictures.
        views: corners by name of the picture.
        size: width and height of all pictures [px].

    Returns:
        The lens, and the names of the pictures that were left out as much worse than the others.

    Raises:
        InvalidInputError: fewer than LEAST_VIEWS pictures, or they say nothing about a lens.
    """
    if len(views) < LEAST_VIEWS:
        raise InvalidInputError(
            f"The board was found in {len(views)} pictures, at least {LEAST_VIEWS} are needed.",
            hint="Take sharp pictures of the whole board, from several sides and distances.",
        )
    optics, errors_px = _calibrated(board, list(views.values()), size)
    bound_px = _MANY_TIMES * float(np.median(errors_px))
    bad = tuple(name for name, error in zip(views, errors_px, strict=True) if error > bound_px)
    if not bad or len(views) - len(bad) < LEAST_VIEWS:
        return optics, ()
    kept = [view for name, view in views.items() if name not in bad]
    return _calibrated(board, kept, size)[0], bad


def _calibrated(
    board: Board, views: Sequence[BoardCorners], size: tuple[int, int]
) -> tuple[Optics, F64]:
    """The lens, and the error of each picture [px]."""
    corners = board.corners_m
    try:
        # k3 is left at 0: pictures of a board do not tell it from k2 at the lens's edge
        error_px, matrix, distortion, _, _, spread, _, errors_px = cv2.calibrateCameraExtended(
            [corners[view.numbers].astype(np.float32) for view in views],
            [view.pixels.astype(np.float32) for view in views],
            size,
            np.eye(3),
            np.zeros(5),
            flags=cv2.CALIB_FIX_K3,
        )
    except cv2.error as error:
        raise InvalidInputError(
            "The pictures say nothing about the lens.",
            hint="Tilt the board by 20 to 45 degrees, in another direction for each picture.",
        ) from error
    optics = Optics(
        size=size,
        matrix=np.asarray(matrix, dtype=np.float64),
        distortion=np.asarray(distortion, dtype=np.float64).reshape(-1),
        deviation_px=np.asarray(spread, dtype=np.float64).reshape(-1)[:4],
        error_px=float(error_px),
    )
    return optics, np.asarray(errors_px, dtype=np.float64).reshape(-1)


def pose_of_board(board: Board, optics: Optics, view: BoardCorners) -> F64:
    """float64 (4, 4): the board in the camera's optical frame [m]."""
    _, rotation, translation = cv2.solvePnP(
        board.corners_m[view.numbers], view.pixels, optics.matrix, optics.distortion
    )
    return _pose(np.concatenate([np.ravel(rotation), np.ravel(translation)]))


def solve_beside_board(
    board: Board, optics: Optics, views: Sequence[BoardCorners], T_mount_board: F64
) -> MountedCamera:
    """Measure the pose of a camera that stands still before a board at a known pose (4, 4)."""
    start = T_mount_board @ np.linalg.inv(pose_of_board(board, optics, views[0]))

    def boards(parameters: F64) -> list[F64]:
        return [np.linalg.inv(_pose(parameters)) @ T_mount_board] * len(views)

    return _refined(board, optics, views, _parameters(start), boards)


def solve_with_hand(
    board: Board, optics: Optics, views: Sequence[BoardCorners], T_other_mounts: Sequence[F64]
) -> MountedCamera:
    """Measure the pose of a camera whose mount moves against what holds the board.

    Args:
        board: the board in the pictures, which is fixed to the other frame.
        optics: the camera's lens.
        views: its corners in each picture.
        T_other_mounts: (4, 4) for each picture: the frame of the camera's mount in the other
            frame. For a wrist camera the TCP in the base; for a camera beside the robot and a
            board in the hand the base in the frame of the TCP.

    Raises:
        InvalidInputError: too few pictures, or the hand turned about one axis only.
    """
    if len(views) < LEAST_VIEWS:
        raise InvalidInputError(
            f"{len(views)} pictures with the board and the measured arm, at least {LEAST_VIEWS} "
            "are needed.",
            hint="Take pictures in more postures of the arm.",
        )
    T_camera_boards = [pose_of_board(board, optics, view) for view in views]
    T_mount_camera = _hand_eye(T_other_mounts, T_camera_boards)
    T_other_boards = [
        mount @ T_mount_camera @ seen
        for mount, seen in zip(T_other_mounts, T_camera_boards, strict=True)
    ]
    rotations = np.array([pose[:3, :3] for pose in T_other_boards])
    T_other_board = np.eye(4)
    T_other_board[:3, :3] = Rotation.from_matrix(rotations).mean().as_matrix()
    T_other_board[:3, 3] = np.mean([pose[:3, 3] for pose in T_other_boards], axis=0)
    start = np.concatenate([_parameters(T_mount_camera), _parameters(T_other_board)])

    def boards(parameters: F64) -> list[F64]:
        camera, place = np.linalg.inv(_pose(parameters[:6])), _pose(parameters[6:])
        return [camera @ np.linalg.inv(mount) @ place for mount in T_other_mounts]

    return _refined(board, optics, views, start, boards)


def _hand_eye(T_other_mounts: Sequence[F64], T_camera_boards: Sequence[F64]) -> F64:
    """T_mount_camera X of A X = X B for motions A of the mount and B of the board in the camera.

    Source: Park and Martin 1994, "Robot sensor calibration: solving AX = XB on the Euclidean
    group": the axes of A are those of B, turned by X; the translation follows linearly.
    """
    motions = []
    for i in range(len(T_other_mounts)):
        for j in range(i):
            of_mount = np.linalg.inv(T_other_mounts[i]) @ T_other_mounts[j]
            of_board = T_camera_boards[i] @ np.linalg.inv(T_camera_boards[j])
            if np.linalg.norm(_parameters(of_mount)[:3]) > _LEAST_TURN_RAD:
                motions.append((of_mount, of_board))
    turns = np.array([[_parameters(part)[:3] for part in motion] for motion in motions])
    spread = np.linalg.svd(turns[:, 0], compute_uv=False) if len(motions) > 1 else np.zeros(3)
    if spread[1] <= _LEAST_SPREAD * spread[0]:
        raise InvalidInputError(
            "The hand turned about one axis only, or hardly.",
            hint="Tilt it by 20 to 45 degrees about two axes at least.",
        )
    rotation = Rotation.align_vectors(turns[:, 0], turns[:, 1])[0].as_matrix()
    rows = np.concatenate([of_mount[:3, :3] - np.eye(3) for of_mount, _ in motions])
    right = np.concatenate([rotation @ b[:3, 3] - a[:3, 3] for a, b in motions])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, np.linalg.lstsq(rows, right, rcond=None)[0]
    return pose


def _refined(
    board: Board,
    optics: Optics,
    views: Sequence[BoardCorners],
    start: F64,
    boards: Callable[[F64], Sequence[F64]],
) -> MountedCamera:
    """The pose with the least squared distances of corners.

    Args:
        board, optics, views: what was seen.
        start: parameters near the best ones; the first six are those of T_mount_camera.
        boards: poses of the board in the camera, (4, 4) for each picture, by the parameters.
    """
    corners = board.corners_m

    def distances_px(parameters: F64, matrix: F64 = optics.matrix) -> F64:
        parts = []
        for view, place in zip(views, boards(parameters), strict=True):
            turn, shift = np.split(_parameters(place), 2)
            seen = cv2.projectPoints(corners[view.numbers], turn, shift, matrix, optics.distortion)
            parts.append(seen[0].reshape(-1, 2) - view.pixels)
        return np.concatenate(parts).reshape(-1)

    found = least_squares(distances_px, start, x_scale="jac", method="lm")
    inverse = np.linalg.pinv(found.jac.T @ found.jac)
    ends = np.cumsum([2 * len(view.numbers) for view in views])[:-1]
    pulls = np.array(
        [
            jacobian.T @ distances
            for jacobian, distances in zip(
                np.split(found.jac, ends), np.split(found.fun, ends), strict=True
            )
        ]
    )
    count = len(views)
    if count > 2:
        # distances within one picture have a common cause, such as the arm's error
        covariance = inverse @ (pulls.T @ pulls) @ inverse * count / (count - 2)
    else:
        covariance = inverse * float(found.fun @ found.fun) / max(1, len(found.fun) - len(start))
    places = ((0, 0), (1, 1), (0, 2), (1, 2))
    for place, deviation_px in zip(places, optics.deviation_px.tolist(), strict=True):
        other = optics.matrix.copy()
        other[place] += deviation_px
        shift = inverse @ found.jac.T @ (distances_px(found.x, other) - found.fun)
        covariance = covariance + np.outer(shift, shift)
    return MountedCamera(
        T_mount_camera=_pose(found.x[:6]),
        error_px=math.sqrt(2 * float(np.mean(found.fun**2))),
        deviation_m=_longest(covariance[3:6, 3:6]),
        deviation_rad=_longest(covariance[:3, :3]),
        views=count,
    )


def board_at_corners(board: Board, touched_m: Mapping[int, F64]) -> tuple[F64, float]:
    """Pose of a board by the positions of its outer corners.

    Args:
        board: the board.
        touched_m: float64 (3,) in the frame wanted [m] by number of the corner, 1 to 4.

    Returns:
        float64 (4, 4), and the root mean square distance of the corners from it [m].

    Raises:
        InvalidInputError: fewer than three corners, or all on one line.
    """
    if len(touched_m) < 3:
        raise InvalidInputError(f"{len(touched_m)} corners of the board, at least 3 are needed.")
    own = board.outer_corners_m[[number - 1 for number in touched_m]]
    found = np.array(list(touched_m.values()))
    centre, found_centre = own.mean(axis=0), found.mean(axis=0)
    if np.linalg.svd(found - found_centre, compute_uv=False)[1] < _LEAST_APART_M:
        raise InvalidInputError(
            "The touched corners lie on one line, or at one place.",
            hint="Touch other corners, as they are numbered on the print.",
        )
    rotation, _ = Rotation.align_vectors(found - found_centre, own - centre)
    pose = np.eye(4)
    pose[:3, :3] = rotation.as_matrix()
    pose[:3, 3] = found_centre - pose[:3, :3] @ centre
    away_m = own @ pose[:3, :3].T + pose[:3, 3] - found
    return pose, float(np.sqrt(np.mean(np.sum(away_m**2, axis=1))))


def _pose(parameters: F64) -> F64:
    """Rotation vector [rad] and translation [m], (6,) -> (4, 4)."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(parameters[:3]).as_matrix()
    pose[:3, 3] = parameters[3:]
    return pose


def _parameters(pose: F64) -> F64:
    """The inverse of `_pose`."""
    return np.concatenate([Rotation.from_matrix(pose[:3, :3]).as_rotvec(), pose[:3, 3]])


def _longest(covariance: F64) -> float:
    """Standard deviation along the longest axis."""
    return math.sqrt(max(0.0, float(np.linalg.eigvalsh(covariance)[-1])))
