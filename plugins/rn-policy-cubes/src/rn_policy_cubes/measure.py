"""Open-loop metrics on held-out views, with all visual tokens: they show whether closed-loop
evaluation is worthwhile.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
import torch
from torch import Tensor

from rn_policy_cubes.dataset import Shards, every
from rn_policy_cubes.demonstrations import COLOURS
from rn_policy_cubes.labels import PLACE_SCALE
from rn_policy_cubes.losses import Helpers, losses
from rn_policy_cubes.network import CubesNetwork
from rn_policy_cubes.recipe import MOVE_SCALE_M
from rn_policy_cubes.words import Prompts

_VIEWS = 8
_NEAR_M, _FAR_M = 0.06, 0.10


@dataclass(frozen=True, slots=True)
class Figures:
    """Metrics over all held-out views, with each colour named.

    Attributes:
        pointing: balanced accuracy of the pointing head after the second layer.
        named_nearest: fraction of pairs whose predicted place is nearest to the named cube.
        place_mm: median distance between predicted and true place; `place_near_mm` within 6 cm of
            the TCP.
        turn_rad: median error of the predicted turn to the cube, for cubes farther than 10 cm from
            the TCP, where turns are evenly distributed; without any information it is pi / 8.
        yaw_rad: likewise for its yaw in the base frame.
        action_mm: mean absolute error of a move, per axis; `action_near_mm` likewise near the cube.
        grip: fraction of actions with the right opening; `grip_near` near the cube.
    """

    pointing: float
    named_nearest: float
    place_mm: float
    place_near_mm: float
    turn_rad: float
    yaw_rad: float
    action_mm: float
    action_near_mm: float
    grip: float
    grip_near: float

    def __str__(self) -> str:
        """Text for people."""
        named = (
            f"place nearest to the named cube {100 * self.named_nearest:.0f} %, off by "
            f"{self.place_mm:.0f} mm"
        )
        return (
            f"{named}; moves off by {self.action_mm:.1f} mm, gripper right {100 * self.grip:.0f} %"
        )

    def as_dict(self) -> dict[str, float]:
        """Entries of the training curve."""
        return {f"held_out_{name}": value for name, value in asdict(self).items()}


@torch.no_grad()
def measure(
    network: CubesNetwork,
    helpers: Helpers,
    shards: Shards,
    prompts: Prompts,
    device: torch.device,
    most: int | None = None,
) -> Figures:
    """Metrics of a network, over all views or `most` of them."""
    told, true, move, grip, known, distance, pointing, turn, yaw = ([] for _ in range(9))
    for batch in every(shards, prompts, _VIEWS, most):
        batch = batch.to(device)
        with torch.autocast(device.type, torch.bfloat16):
            thought = network(batch.look, batch.state, batch.ids, torch.bfloat16)
        result = losses(thought, helpers, batch)
        pointing.append(float(result.accuracy))
        told.append(result.told[:, :3].cpu().numpy() / PLACE_SCALE)
        true.append(batch.place[:, :3].cpu().numpy() / PLACE_SCALE)
        turn.append(turn_error(result.told[:, 3:5], batch.place[:, 3:5]))
        yaw.append(turn_error(result.told[:, 5:], batch.place[:, 5:]))
        error = (thought.actions.float() - batch.actions).abs()
        move.append(error[..., :3].mean(dim=(1, 2)).cpu().numpy() * MOVE_SCALE_M)
        said = thought.actions[..., 6].float() > 0.5
        grip.append((said == (batch.actions[..., 6] > 0.5)).float().mean(dim=1).cpu().numpy())
        known.append(batch.known.cpu().numpy() > 0.5)
        distance.append(batch.distance_m.cpu().numpy())
    ok, far = np.concatenate(known), np.concatenate(distance)
    near = ok & (far < _NEAR_M)
    places, places_told = np.concatenate(true), np.concatenate(told)
    error_m = np.linalg.norm(places - places_told, axis=-1)
    cubes = places.reshape(-1, 1, len(COLOURS), 3)
    gaps = np.linalg.norm(cubes - places_told.reshape(-1, len(COLOURS), 1, 3), axis=-1)
    moves, grips = np.concatenate(move), np.concatenate(grip)
    return Figures(
        pointing=float(np.mean(pointing)),
        named_nearest=float((gaps.argmin(axis=-1) == np.arange(len(COLOURS))).mean()),
        place_mm=float(np.median(error_m) * 1e3),
        place_near_mm=_mean(np.median, error_m[near]) * 1e3,
        turn_rad=_mean(np.median, np.concatenate(turn)[far > _FAR_M]),
        yaw_rad=_mean(np.median, np.concatenate(yaw)[far > _FAR_M]),
        action_mm=float(moves[ok].mean() * 1e3),
        action_near_mm=_mean(np.mean, moves[near]) * 1e3,
        grip=float(grips[ok].mean()),
        grip_near=_mean(np.mean, grips[near]),
    )


def turn_error(told: Tensor, true: Tensor) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Error [rad] of turns (pairs, 2), given as sine and cosine of four times the angle."""
    four = torch.atan2(told[:, 0], told[:, 1]) - torch.atan2(true[:, 0], true[:, 1])
    error: np.ndarray[tuple[int, ...], np.dtype[np.float64]]
    error = torch.atan2(four.sin(), four.cos()).abs().double().cpu().numpy() / 4
    return error


def _mean(function: object, values: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> float:
    """The function of the values; NaN without values."""
    return float(function(values)) if len(values) else float("nan")  # type: ignore[operator]
