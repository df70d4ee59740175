"""Rotation maths: maps invert each other, matrices are rotations, quaternions are unit with w >= 0.

Tolerances: float64 carries 1e-16 relative; near pi the logarithm loses half of the digits, hence
1e-7 there.
"""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from roboneuron.contract.rotation import (
    matrix_from_quaternion,
    matrix_from_rotvec,
    quaternion_from_matrix,
    rotvec_from_matrix,
)

VECTORS = arrays(np.float64, 3, elements=st.floats(-3.0, 3.0))
BOUNDED = VECTORS.filter(lambda v: np.linalg.norm(v) < np.pi - 1e-3)


@given(VECTORS)
def test_the_exponential_is_a_rotation(rotvec):
    matrix = matrix_from_rotvec(rotvec)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-12)
    assert abs(np.linalg.det(matrix) - 1) < 1e-12


@given(BOUNDED)
def test_the_logarithm_inverts_the_exponential(rotvec):
    np.testing.assert_allclose(rotvec_from_matrix(matrix_from_rotvec(rotvec)), rotvec, atol=1e-7)


@given(VECTORS)
def test_the_exponential_inverts_the_logarithm_at_any_angle(rotvec):
    matrix = matrix_from_rotvec(rotvec)
    logarithm = rotvec_from_matrix(matrix)
    assert np.linalg.norm(logarithm) <= np.pi + 1e-9
    np.testing.assert_allclose(matrix_from_rotvec(logarithm), matrix, atol=1e-7)


@given(VECTORS)
def test_quaternions_are_unit_with_positive_w_and_invert(rotvec):
    matrix = matrix_from_rotvec(rotvec)
    quaternion = quaternion_from_matrix(matrix)
    assert abs(np.linalg.norm(quaternion) - 1) < 1e-12
    assert quaternion[3] >= 0
    np.testing.assert_allclose(matrix_from_quaternion(quaternion), matrix, atol=1e-12)


@given(VECTORS, st.floats(0.1, 10.0))
def test_a_quaternion_of_another_length_is_normalised(rotvec, length):
    quaternion = quaternion_from_matrix(matrix_from_rotvec(rotvec))
    np.testing.assert_allclose(
        matrix_from_quaternion(length * quaternion), matrix_from_quaternion(quaternion), atol=1e-12
    )


def test_a_quarter_turn_about_z_takes_x_to_y():
    np.testing.assert_allclose(
        matrix_from_rotvec(np.array([0, 0, np.pi / 2])) @ [1, 0, 0], [0, 1, 0], atol=1e-15
    )


def test_half_turns_about_each_axis_survive_the_logarithm():
    for axis in np.eye(3):
        logarithm = rotvec_from_matrix(matrix_from_rotvec(np.pi * axis))
        np.testing.assert_allclose(np.abs(logarithm), np.pi * axis, atol=1e-7)


def test_tiny_rotations_keep_their_direction():
    tiny = np.array([1e-10, -2e-10, 3e-10])
    np.testing.assert_allclose(rotvec_from_matrix(matrix_from_rotvec(tiny)), tiny, atol=1e-16)
