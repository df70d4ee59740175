"""Pose and lens of a camera against the truth, from noisy pictures through a distorting lens: on
the hand, beside the robot with the board in the hand, and beside the robot before a touched board.
"""

from __future__ import annotations

import dataclasses
from functools import cache

import cv2
import numpy as np
import pytest
from board_pictures import BOARD, DISTORTION, MATRIX, SIZE, difference, pose, views

from rn_cameras.board import BoardCorners
from rn_cameras.solving import (
    board_at_corners,
    measure_optics,
    solve_beside_board,
    solve_with_hand,
)
from roboneuron import InvalidInputError

ON_HAND = pose((170, 10, 5), (0.05, 0.02, -0.04))
"""Camera in the frame of the TCP."""
BESIDE = pose((150, 30, 10), (1.0, 0.2, 0.7))
"""Camera in the base frame."""
IN_HAND = pose((3, 5, 90), (0.02, 0.0, 0.1))
"""Board in the frame of the TCP."""
ON_TABLE = pose((180, 0, 20), (0.5, 0.1, 0.0))
"""Board in the base frame."""
ARM_ERRORS = [(0.0, 0.0), (0.3, 0.03)]
"""Of each posture [mm, degrees]."""


@cache
def seen():
    """Poses of the board in the camera, and its corners in the pictures."""
    places, pictures = views()
    return places, {str(number): BOARD.find(picture) for number, picture in enumerate(pictures)}


@cache
def optics():
    return measure_optics(BOARD, seen()[1], SIZE)[0]


def erring(tcp, arm_error, random):
    """A TCP as an arm with errors measures it."""
    mm, degrees = (random.normal(0, size / np.sqrt(3), 3) for size in arm_error)
    return tcp @ pose(tuple(degrees), tuple(mm / 1000))


def mounts(setup, places, arm_error=(0.0, 0.0)):
    """Frame of the camera's mount in the other frame, for each picture."""
    random = np.random.default_rng(3)
    if setup == "eye-in-hand":
        tcps = [ON_TABLE @ np.linalg.inv(ON_HAND @ place) for place in places]
        return [erring(tcp, arm_error, random) for tcp in tcps]
    tcps = [BESIDE @ place @ np.linalg.inv(IN_HAND) for place in places]
    return [np.linalg.inv(erring(tcp, arm_error, random)) for tcp in tcps]


def check(found, true):
    """Within 2 mm and 0.5 degrees, and no worse than is told."""
    away_m, away_deg = difference(found.T_mount_camera, true)
    assert away_m < 0.002
    assert away_deg < 0.5
    assert away_m < 4 * found.deviation_m
    assert away_deg < 4 * np.degrees(found.deviation_rad)


def test_the_lens_is_measured():
    found = optics()
    assert found.matrix[[0, 1], [0, 1]] == pytest.approx(MATRIX[[0, 1], [0, 1]], rel=0.003)
    assert found.matrix[:2, 2] == pytest.approx(MATRIX[:2, 2], abs=3)
    assert found.distortion[:2] == pytest.approx(DISTORTION[:2], abs=0.03)
    assert found.error_px < 0.2


@pytest.mark.parametrize("arm_error", ARM_ERRORS, ids=["exact arm", "0.3 mm, 0.03 degrees"])
@pytest.mark.parametrize(("setup", "true"), [("eye-in-hand", ON_HAND), ("eye-to-hand", BESIDE)])
def test_the_pose_is_measured_by_moving_the_hand(setup, true, arm_error):
    places, found_in = seen()
    others = mounts(setup, places, arm_error)
    check(solve_with_hand(BOARD, optics(), list(found_in.values()), others), true)


@pytest.mark.parametrize("corners", [(1, 2, 3), (1, 2, 4), (1, 2, 3, 4)])
def test_the_pose_is_measured_before_a_board_whose_corners_are_touched(corners):
    places, found_in = seen()
    board = BESIDE @ places[0]
    own = BOARD.outer_corners_m @ board[:3, :3].T + board[:3, 3]
    found, away_m = board_at_corners(BOARD, {number: own[number - 1] for number in corners})
    assert away_m < 1e-6
    assert difference(found, board)[0] < 1e-6
    check(solve_beside_board(BOARD, optics(), [found_in["0"]], found), BESIDE)


def test_corners_of_another_board_do_not_fit():
    touched = BOARD.outer_corners_m * 1.1
    _, away_m = board_at_corners(BOARD, dict(enumerate(touched, start=1)))
    assert away_m > 0.01


@pytest.mark.parametrize("touched", [(0, 0, 0), (0, 1, 0), (1, 1, 1)])
def test_corners_on_one_line_are_refused(touched):
    places = {number: BOARD.outer_corners_m[of] for number, of in enumerate(touched, start=1)}
    with pytest.raises(InvalidInputError, match="one line"):
        board_at_corners(BOARD, places)


def test_a_bad_picture_is_named_and_left_out():
    found_in = dict(seen()[1])
    sharp = found_in["3"]
    noise_px = np.random.default_rng(5).normal(0, 4, sharp.pixels.shape)
    found_in["3"] = BoardCorners(numbers=sharp.numbers, pixels=sharp.pixels + noise_px)
    found, bad = measure_optics(BOARD, found_in, SIZE)
    assert bad == ("3",)
    assert found.error_px < 0.2


def test_a_wrong_joint_is_told_as_uncertainty():
    places, found_in = seen()
    others = mounts("eye-in-hand", places)
    good = solve_with_hand(BOARD, optics(), list(found_in.values()), others)
    others[4] = others[4] @ pose((0, 5, 0), (0, 0, 0))
    found = solve_with_hand(BOARD, optics(), list(found_in.values()), others)
    assert found.deviation_m > 3 * good.deviation_m
    assert found.error_px > 3 * good.error_px


@pytest.mark.parametrize("setup", ["eye-in-hand", "eye-to-hand"])
def test_a_hand_that_turns_about_one_axis_only_is_refused(setup):
    _, found_in = seen()
    one = [pose((0, 0, 10.0 * i), (0.01 * i, 0, 0)) for i in range(len(found_in))]
    turned = [np.linalg.inv(ON_HAND) @ np.linalg.inv(place) @ ON_TABLE for place in one]
    exact = dict(zip(found_in, map(projected, turned), strict=True))
    exact_optics = dataclasses.replace(optics(), matrix=MATRIX, distortion=DISTORTION)
    others = one if setup == "eye-in-hand" else [np.linalg.inv(place) for place in one]
    with pytest.raises(InvalidInputError, match="axis"):
        solve_with_hand(BOARD, exact_optics, list(exact.values()), others)


def projected(place):
    """Exact corners of a board, wherever it is."""
    turn, shift = cv2.Rodrigues(place[:3, :3])[0], place[:3, 3]
    pixels = cv2.projectPoints(BOARD.corners_m, turn, shift, MATRIX, DISTORTION)[0]
    return BoardCorners(numbers=np.arange(len(BOARD.corners_m)), pixels=pixels.reshape(-1, 2))


def test_too_few_pictures_are_refused():
    places, found_in = seen()
    few = dict(list(found_in.items())[:7])
    with pytest.raises(InvalidInputError, match="7"):
        measure_optics(BOARD, few, SIZE)
    others = mounts("eye-in-hand", places)[:7]
    with pytest.raises(InvalidInputError, match="7"):
        solve_with_hand(BOARD, optics(), list(few.values()), others)
    with pytest.raises(InvalidInputError, match="2"):
        board_at_corners(BOARD, {1: np.zeros(3), 2: np.ones(3)})
