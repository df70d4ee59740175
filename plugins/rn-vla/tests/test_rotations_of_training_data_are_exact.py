"""Roll-pitch-yaw and the forms near a gripper that points down: conversions invert each other and
have no jump.
"""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from rn_vla.rotation import matrix_from_rpy, rotvec_by_down, rpy_by_down, rpy_from_matrix
from roboneuron import matrix_from_rotvec


@given(st.tuples(st.floats(-3, 3), st.floats(-1.5, 1.5), st.floats(-3, 3)))
def test_roll_pitch_yaw_survive_the_way_through_a_matrix(rpy):
    np.testing.assert_allclose(rpy_from_matrix(matrix_from_rpy(np.array(rpy))), rpy, atol=1e-9)


def test_a_path_through_gripper_down_has_no_jump_in_either_form():
    """Tilts of -9 .. 9 degrees about four axes: neighbours on the path stay neighbours (0.2 degrees
    a step).
    """
    for axis in np.array([[1, 0, 0], [0, 1, 0], [0.6, 0.8, 0], [0.5, -0.5, 0.7]]):
        path = [
            matrix_from_rotvec(axis * np.deg2rad(a)) @ np.diag([1.0, -1, -1])
            for a in np.linspace(-9, 9, 91)
        ]
        for form in (rotvec_by_down, rpy_by_down):
            steps = np.diff([form(matrix) for matrix in path], axis=0)
            assert np.abs(steps).max() < 0.02, form


def test_gripper_down_is_pi_about_x_or_level():
    down = np.diag([1.0, -1.0, -1.0])
    np.testing.assert_allclose(rotvec_by_down(down), [np.pi, 0, 0], atol=1e-12)
    np.testing.assert_allclose(rpy_by_down(down), 0, atol=1e-12)
