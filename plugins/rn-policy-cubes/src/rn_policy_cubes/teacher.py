"""The teacher: maps the true state of the simulator to the next actions. It is stateless.

Because it depends only on the present state, it can label any state with the actions from there,
for each cube of an image: four named colours give four labels. It is vectorised over situations.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

HOVER_M, GRASP_M, LIFT_M = 0.12, 0.020, 0.24
"""TCP heights: above the cubes, at the grasp, and at the end of the lift."""
STEP_M, TURN_RAD = 0.03, 0.20
"""Largest translation and rotation of one action."""
STEP_S = 0.1
"""Duration of one action."""
_GAIN = 0.5
_REACHED = 0.93
"""Fraction of a commanded motion that the simulated arm has executed after one action. Measured."""
_FINGERS_PER_STEP = 0.13
"""Change of the opening in one action."""
_FULL_OPENING_M = 0.08
_QUARTER_TURN = np.pi / 2
_STUCK_OPENING, _CREEP_M = 0.78, 0.008
_CLEAR_M, _BESIDE_M = 0.075, 0.028


@dataclass(frozen=True, slots=True)
class Situations:
    """Input of the teacher, for n situations.

    Attributes:
        tcp_m: float64 (n, 3), TCP position in the base frame.
        yaw_rad: (n,), yaw of the gripper about the vertical.
        tilt_rad: (n, 2), turn about x and y that would make the gripper point straight down.
        opening: (n,), 0 closed .. 1 open.
        cube_m: (n, 3), centre of the named cube.
        cube_yaw_rad: (n,), yaw of any of its side faces.
        edge_m: (n,), length of its edges.
    """

    tcp_m: F64
    yaw_rad: F64
    tilt_rad: F64
    opening: F64
    cube_m: F64
    cube_yaw_rad: F64
    edge_m: F64

    @property
    def to_cube_m(self) -> F64:
        """Vector from TCP to cube, (n, 3)."""
        return self.cube_m - self.tcp_m

    @property
    def distance_m(self) -> F64:
        """Horizontal distance of cube and TCP, (n,)."""
        return np.asarray(np.linalg.norm(self.to_cube_m[:, :2], axis=1))

    @property
    def turn_rad(self) -> F64:
        """Turn that aligns the fingers with a side face; (n,).

        From above it goes to the face whose yaw in the base frame is within an eighth of a full
        turn, so that where it ends does not depend on the gripper's own yaw: a network learns the
        one from the image, and subtracts the other. With the cube between the fingers it is the
        smallest one.
        """
        facing = _within_an_eighth(self.cube_yaw_rad) - self.yaw_rad
        return np.where(self.is_inside, _within_an_eighth(facing), facing)

    @property
    def is_inside(self) -> Mask:
        """True if the cube is between the fingers, (n,)."""
        return np.asarray((self.distance_m < 0.020) & (np.abs(self.to_cube_m[:, 2]) < 0.020))

    @property
    def is_gripped(self) -> Mask:
        """True if the fingers are closed on the cube, (n,)."""
        return np.asarray(self.is_inside & (self.opening < self.edge_m / _FULL_OPENING_M + 0.045))


def _within_an_eighth(angle_rad: F64) -> F64:
    """The angles but for quarter turns, within an eighth of a full turn."""
    return np.asarray(angle_rad - _QUARTER_TURN * np.round(angle_rad / _QUARTER_TURN))


def act(now: Situations) -> F64:
    """The next actions, float64 (n, 7): move [m], rotation vector [rad], opening; in the base
    frame.
    """
    height, turn, inside = now.tcp_m[:, 2], now.turn_rad, now.is_inside
    to_grasp = np.column_stack([now.to_cube_m[:, :2], GRASP_M - height])
    is_closing = inside & (now.opening < 0.93) & (height < 0.05)
    is_placed = (
        (now.distance_m < 0.010) & (np.abs(height - GRASP_M) < 0.010) & (np.abs(turn) < 0.20)
    )
    closes = is_placed | (is_closing & (np.abs(turn) < 0.5))
    # across its corners a cube keeps the fingers further open than its width
    lifts = inside & (now.opening < _STUCK_OPENING)
    rise = _GAIN * (LIFT_M - height)
    lift = np.where(now.is_gripped, rise, np.minimum(rise, _CREEP_M))
    approach = np.column_stack(
        [now.to_cube_m[:, :2] * _sideways(now), _approach_height(now) - height]
    )
    settle = np.where(is_closing, 0.3, 1.0)[:, None] * to_grasp
    move = np.where(closes[:, None], settle, approach) * _GAIN
    move[lifts] = 0.0
    move[lifts, 2] = lift[lifts]
    opens = ~(lifts | closes)
    turns = np.column_stack([now.tilt_rad * _GAIN, np.where(opens, _GAIN * turn, 0.0)])
    return np.column_stack(
        [_shortened(move, STEP_M), _shortened(turns, TURN_RAD), opens.astype(np.float64)]
    )


def _approach_height(now: Situations) -> F64:
    """Funnel-shaped height: the smaller the distance and the turn, the lower."""
    height, turn, distance = now.tcp_m[:, 2], np.abs(now.turn_rad), now.distance_m
    above = np.maximum((distance - 0.008) * 4.0, (turn - 0.12) * 0.5)
    funnel = GRASP_M + np.clip(above, 0.0, HOVER_M - GRASP_M)
    # closed fingers do not descend
    stays_up = (now.opening < 0.85) & ((height > 0.05) | (distance > 0.03))
    return np.where(stays_up, HOVER_M, funnel)


def _sideways(now: Situations) -> F64:
    """Fraction of the lateral motion: low and next to a cube, the gripper rises first; (n, 1)."""
    height = now.tcp_m[:, 2]
    share = np.clip((height - 0.045) / 0.03, 0.0, 1.0)
    return np.where((height < _CLEAR_M) & (now.distance_m > _BESIDE_M), share, 1.0)[:, None]


def _shortened(vectors: F64, longest: float) -> F64:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors * np.minimum(1.0, longest / np.maximum(length, 1e-12)))


def chunks(now: Situations, rows: int) -> F64:
    """The next `rows` actions, float64 (n, rows, 7): the teacher rolled out without physics."""
    actions = []
    for _ in range(rows):
        actions.append(act(now))
        now = after(now, actions[-1])
    return np.stack(actions, axis=1)


def after(now: Situations, action: F64) -> Situations:
    """Situations after the actions, as measured for the simulated arm; a closed gripper moves the
    cube.
    """
    closing = action[:, 6] < 0.5
    move = _REACHED * action[:, :3]
    narrowest = np.where(now.is_inside, now.edge_m / _FULL_OPENING_M, 0.0)
    return replace(
        now,
        tcp_m=now.tcp_m + move,
        cube_m=now.cube_m + np.where((closing & now.is_gripped)[:, None], move, 0.0),
        yaw_rad=now.yaw_rad + _REACHED * action[:, 5],
        tilt_rad=now.tilt_rad - _REACHED * action[:, 3:5],
        opening=np.where(
            closing,
            np.maximum(narrowest, now.opening - _FINGERS_PER_STEP),
            np.minimum(1.0, now.opening + _FINGERS_PER_STEP),
        ),
    )


def tilt_of(rotation: F64) -> F64:
    """Rotation about x and y, (n, 2) [rad], that points the z axis of TCP rotations (n, 3, 3)
    straight down.
    """
    axis = np.cross(rotation[..., 2], [0.0, 0.0, -1.0])
    sine = np.linalg.norm(axis, axis=-1, keepdims=True)
    angle = np.arctan2(sine, -rotation[..., 2, 2, None])
    return np.asarray(np.where(sine > 1e-9, axis / np.maximum(sine, 1e-9) * angle, 0.0)[..., :2])


def yaw_of(rotation: F64) -> float:
    """Yaw [rad] of the most horizontal axis of a rotation (3, 3)."""
    flattest = int(np.argmin(np.abs(rotation[2])))
    return float(np.arctan2(rotation[1, flattest], rotation[0, flattest]))
