"""Conversion of a recorded row to the network's input and labels, for every colour that might be
named.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rn_policy_cubes.demonstrations import COLOURS, situations
from rn_policy_cubes.recipe import (
    ACTION_SCALE,
    ACTION_WIDTH,
    GRID,
    PATCH_PX,
    PATCH_VALUES,
    PATCHES,
    ROWS,
    STATE_HIGH,
    STATE_LOW,
)
from rn_policy_cubes.teacher import chunks
from rn_vla.rotation import rpy_by_down

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]

PLACE_SCALE = 5.0
"""Positions relative to the TCP are labelled in units of 1 / PLACE_SCALE metres."""
PLACE_WIDTH = 7
_LOW, _HIGH = np.array(STATE_LOW), np.array(STATE_HIGH)
_PIXELS_PER_PATCH = PATCH_PX * PATCH_PX


@dataclass(frozen=True, slots=True)
class Labels:
    """Labels of n views and their c colours.

    Attributes:
        state: float32 (n, 7), normalised.
        actions: float32 (n, c, length, 7), normalised.
        place: float32 (n, c, 7), cube relative to the TCP, scaled; sine and cosine of four times
            the turn to it; the same of its yaw in the base frame.
        known: bool (n, c), False if the teacher has no sensible answer because the gripper holds
            another cube.
        distance_m: float32 (n, c), between TCP and cube.
        is_target: bool (n, c), the cube that the demonstration picked.
        is_placed: bool (n,), True if `place` and `distance_m` are known.
    """

    state: F32
    actions: F32
    place: F32
    known: NDArray[np.bool_]
    distance_m: F32
    is_target: NDArray[np.bool_]
    is_placed: NDArray[np.bool_]


def state_of(row: np.void | NDArray[np.void]) -> F32:
    """The state of one view, normalised as in rn-backend-oft, float32 (7,)."""
    rotation = row["rotation"].astype(np.float64)
    values = np.concatenate([row["tcp_m"], rpy_by_down(rotation), [row["opening"]]])
    scaled = np.clip(2.0 * (values - _LOW) / (_HIGH - _LOW) - 1.0, -1.0, 1.0)
    return np.asarray(scaled, dtype=np.float32)


def label(rows: NDArray[np.void], length: int = ROWS) -> Labels:
    """The teacher's labels for every row, with chunks of `length` actions."""
    count, colours = len(rows), len(COLOURS)
    actions = np.empty((count, colours, length, ACTION_WIDTH), dtype=np.float32)
    place = np.empty((count, colours, PLACE_WIDTH), dtype=np.float32)
    distance = np.empty((count, colours), dtype=np.float32)
    for cube in range(colours):
        now = situations(rows, cube)
        # labels are invariant to quarter turns; the yaw is visible without knowing the gripper's
        angles = 4 * np.column_stack([now.turn_rad, now.cube_yaw_rad])
        sine, cosine = np.sin(angles), np.cos(angles)
        distance[:, cube] = np.linalg.norm(now.to_cube_m, axis=1)
        place[:, cube, :3] = now.to_cube_m * PLACE_SCALE
        place[:, cube, 3::2], place[:, cube, 4::2] = sine, cosine
        actions[:, cube] = chunks(now, length)
    is_target = rows["target"][:, None] == np.arange(colours)
    is_busy = (rows["opening"] < 0.9) & (distance[is_target] < 0.03)
    known = is_target | ~is_busy[:, None]
    state = np.stack([state_of(row) for row in rows])
    actions[..., :6] /= np.array(ACTION_SCALE, dtype=np.float32)
    is_placed = np.ones(count, dtype=bool)
    return Labels(state, actions, place, known, distance, is_target, is_placed)


def patches_of(pictures: U8) -> U8:
    """Divide images (n, 224, 224, 3) into patches (n, 256, 588), channel first, as a vision tower
    does.
    """
    cut = pictures.reshape(-1, GRID, PATCH_PX, GRID, PATCH_PX, 3).transpose(0, 1, 3, 5, 2, 4)
    return np.ascontiguousarray(cut).reshape(-1, PATCHES, PATCH_VALUES)


def coloured_share(patches: U8) -> F32:
    """Fraction of each patch (n, 256, 588) that shows a cube, by colour; float32 (n, 256, c)."""
    values = patches.reshape(*patches.shape[:2], 3, _PIXELS_PER_PATCH).astype(np.int16)
    red, green, blue = values[:, :, 0], values[:, :, 1], values[:, :, 2]
    masks = {
        "red": (red > green + 50) & (red > blue + 50) & (green < red // 2),
        "green": (green > red + 40) & (green > blue + 30),
        "blue": (blue > red + 50) & (blue > green + 30),
        "yellow": (red > blue + 70) & (green > blue + 50) & (green > red // 2),
    }
    return np.stack([masks[colour].mean(axis=-1, dtype=np.float32) for colour in COLOURS], axis=-1)
