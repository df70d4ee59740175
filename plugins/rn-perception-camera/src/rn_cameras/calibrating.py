"""Calibration of a camera from a folder of pictures."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rn_cameras.board import Board, BoardCorners
from rn_cameras.pictures import STILL, MeasuredFile, PictureFolder, as_arrays
from rn_cameras.solving import (
    MountedCamera,
    Optics,
    board_at_corners,
    measure_optics,
    solve_beside_board,
    solve_with_hand,
)
from roboneuron import InvalidInputError, Pose

F64 = NDArray[np.float64]
Setup = Literal["eye-in-hand", "eye-to-hand", "corners"]
Forward = Callable[[Mapping[str, float]], Pose]
"""The TCP in the base frame for measured joints by name."""

MOST_ERROR_PX = 1.0
MOST_DEVIATION_M, MOST_DEVIATION_RAD = 0.005, float(np.radians(1.0))
"""A calibration that is worse than one of these is not written."""
GOOD_M, GOOD_RAD = 0.002, float(np.radians(0.5))


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Calibrated:
    """Result of a calibration.

    Attributes:
        optics: the lens.
        is_optics_measured: False if the camera's driver tells it.
        camera: pose in the frame of its mount.
        corners_m: how far the measured corners of a lying board are from those of a board of its
            size, root mean square; None without one.
        left_out: pictures that were not used, with the reason.
    """

    optics: Optics
    is_optics_measured: bool
    camera: MountedCamera
    corners_m: float | None
    left_out: Mapping[str, str]

    @property
    def refusal(self) -> str:
        """Why it is too inexact to be used; empty if it is not."""
        camera = self.camera
        if max(camera.error_px, self.optics.error_px) > MOST_ERROR_PX:
            return (
                f"corners are {max(camera.error_px, self.optics.error_px):.2f} px from where they "
                f"should be, at most {MOST_ERROR_PX:g} px are accepted"
            )
        if camera.deviation_m > MOST_DEVIATION_M or camera.deviation_rad > MOST_DEVIATION_RAD:
            return (
                f"its pose is uncertain by {camera.deviation_m * 1000:.1f} mm and "
                f"{np.degrees(camera.deviation_rad):.2f} degrees, at most "
                f"{MOST_DEVIATION_M * 1000:g} mm and {np.degrees(MOST_DEVIATION_RAD):g} degrees "
                "are accepted"
            )
        if self.corners_m is not None and self.corners_m > MOST_DEVIATION_M:
            return (
                f"the touched corners are {self.corners_m * 1000:.1f} mm from those of such a "
                f"board, at most {MOST_DEVIATION_M * 1000:g} mm are accepted"
            )
        return ""

    @property
    def is_good(self) -> bool:
        """True if places that it tells are right to GOOD_M and GOOD_RAD, as far as is known."""
        camera = self.camera
        return camera.deviation_m <= GOOD_M and camera.deviation_rad <= GOOD_RAD


def calibrate(folder: PictureFolder, board: Board, setup: Setup, forward: Forward) -> Calibrated:
    """Measure lens and pose of a camera.

    Args:
        folder: the pictures.
        board: the board in them.
        setup: eye-in-hand: the camera is on the hand, the board lies anywhere; eye-to-hand: the
            camera stands, the hand holds the board; corners: the camera stands before a board
            whose corners were measured in the base frame.
        forward: computes the TCP.

    Raises:
        InvalidInputError: too few pictures, or they do not fit together.
        UnsafeError: joints are missing.
    """
    measured = folder.measured()
    left_out: dict[str, str] = {}
    found, size = _find(folder, board, left_out)
    if measured.intrinsics is not None:
        fx, fy, cx, cy = measured.intrinsics
        matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        optics = Optics(size=size, matrix=matrix, distortion=np.zeros(5), deviation_px=np.zeros(4))
    else:
        optics, bad = measure_optics(board, found, size)
        left_out |= dict.fromkeys(bad, "much worse than the others: blurred, or a bent board")
    used = {name: view for name, view in found.items() if name not in left_out}
    camera, corners_m = _pose(used, measured, board, optics, setup, forward)
    return Calibrated(
        optics=optics,
        is_optics_measured=measured.intrinsics is None,
        camera=camera,
        corners_m=corners_m,
        left_out=left_out,
    )


def _find(
    folder: PictureFolder, board: Board, left_out: dict[str, str]
) -> tuple[dict[str, BoardCorners], tuple[int, int]]:
    """Corners by picture, and the size of all pictures [px]; notes what cannot be used.

    Raises:
        InvalidInputError: no picture shows the board.
    """
    found: dict[str, BoardCorners] = {}
    size: tuple[int, int] | None = None
    for name in folder.names(""):
        try:
            picture = folder.read(name)
        except InvalidInputError as error:
            left_out[name] = error.message
            continue
        own = (picture.shape[1], picture.shape[0])
        sighting = board.find(picture)
        if sighting is None:
            left_out[name] = "the board is not seen"
        elif size is not None and own != size:
            left_out[name] = f"it has {own[0]}x{own[1]} pixels, others {size[0]}x{size[1]}"
        else:
            found[name], size = sighting, own
    if size is None:
        raise InvalidInputError(
            f"None of the {len(left_out)} pictures in {folder.path} shows the board of "
            f"{board.columns} x {board.rows} squares.",
            hint="Print it with `roboneuron robot cameras board`, and name --columns and --rows if "
            "they are not its own.",
        )
    return found, size


def _pose(
    found: Mapping[str, BoardCorners],
    measured: MeasuredFile,
    board: Board,
    optics: Optics,
    setup: Setup,
    forward: Forward,
) -> tuple[MountedCamera, float | None]:
    """The pose, and `Calibrated.corners_m`. Raises as `calibrate`."""
    if setup == "corners":
        still = [view for name, view in found.items() if name.startswith(STILL)]
        if not still:
            raise InvalidInputError(
                "No picture shows the board where its corners were measured.",
                hint=f"It is called {STILL}-001.png.",
            )
        place, away_m = board_at_corners(board, as_arrays(measured.corners))
        return solve_beside_board(board, optics, still, place), away_m
    views = {name: view for name, view in found.items() if name in measured.joints}
    mounts: list[F64] = [forward(measured.joints[name]).matrix for name in views]
    if setup == "eye-to-hand":
        mounts = [np.asarray(np.linalg.inv(tcp), dtype=np.float64) for tcp in mounts]
    return solve_with_hand(board, optics, list(views.values()), mounts), None
