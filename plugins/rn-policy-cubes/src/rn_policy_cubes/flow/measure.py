"""Open-loop metrics of the flow policy on held-out views, with all visual tokens and sampled
actions.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
import torch

from rn_policy_cubes.dataset import Shards, every
from rn_policy_cubes.flow.losses import FlowHelpers, from_network, to_network
from rn_policy_cubes.flow.network import CubesFlowNetwork
from rn_policy_cubes.labels import PLACE_SCALE
from rn_policy_cubes.losses import normed
from rn_policy_cubes.words import Prompts

EULER_STEPS = 10
_VIEWS = 8
_NEAR_M = 0.06
_FIRST_ROWS = 5
"""Rows of `action_mm`, so that it compares with the other policy, whose chunks have five."""


@dataclass(frozen=True, slots=True)
class FlowFigures:
    """Metrics over all held-out views, with each colour named.

    Attributes:
        action_mm: mean absolute error of a sampled move, per axis, in the first five rows;
            `action_near_mm` likewise within 6 cm of the cube, `action_late_mm` in the other rows.
        turn_rad: mean absolute error of a turn about the vertical in the first five rows.
        grip: fraction of actions with the right opening; `grip_near` near the cube.
        place_mm: median distance between the true place and the one predicted from the state's
            token.
    """

    action_mm: float
    action_near_mm: float
    action_late_mm: float
    turn_rad: float
    grip: float
    grip_near: float
    place_mm: float

    def __str__(self) -> str:
        """Text for people."""
        return (
            f"moves off by {self.action_mm:.2f} mm ({self.action_near_mm:.2f} near the cube, "
            f"{self.action_late_mm:.2f} later), turns by {self.turn_rad:.3f} rad, gripper right "
            f"{100 * self.grip:.1f} %, place off by {self.place_mm:.0f} mm"
        )

    def as_dict(self) -> dict[str, float]:
        """Entries of the training curve."""
        return {f"held_out_{name}": value for name, value in asdict(self).items()}


@torch.no_grad()
def measure_flow(
    network: CubesFlowNetwork,
    helpers: FlowHelpers,
    shards: Shards,
    prompts: Prompts,
    device: torch.device,
    most: int | None = None,
) -> FlowFigures:
    """Metrics of a network, over all views or `most` of them; the noise is the same each time."""
    errors, grips, known, distances, places = [], [], [], [], []
    random = torch.Generator().manual_seed(0)
    for batch in every(shards, prompts, _VIEWS, most):
        batch = batch.to(device)
        noise = torch.randn(batch.actions.shape, generator=random).to(device)
        with torch.autocast(device.type, torch.bfloat16):
            prefix = network.read(batch.look, batch.ids, torch.bfloat16)
            args = (batch.look, batch.state, batch.ids, noise, EULER_STEPS, torch.bfloat16)
            sampled = from_network(network.sample(*args))
            times = noise.new_ones(len(noise), 1)
            thought = network(prefix, batch.state, noise[:, None], times, torch.bfloat16)
        actions = from_network(to_network(batch.actions))
        errors.append((sampled - actions).abs().cpu().numpy())
        right = (sampled[..., 6] > 0.5) == (actions[..., 6] > 0.5)
        grips.append(right.float().mean(dim=1).cpu().numpy())
        known.append(batch.known.cpu().numpy() > 0.5)
        distances.append(batch.distance_m.cpu().numpy())
        told = helpers.place(normed(thought.state))[:, :3] - batch.place[:, :3]
        places.append(told.norm(dim=-1).cpu().numpy() / PLACE_SCALE)
    ok = np.concatenate(known)
    near = ok & (np.concatenate(distances) < _NEAR_M)
    error, grip = np.concatenate(errors), np.concatenate(grips)
    return FlowFigures(
        action_mm=_mean(error[ok][:, :_FIRST_ROWS, :3]) * 1e3,
        action_near_mm=_mean(error[near][:, :_FIRST_ROWS, :3]) * 1e3,
        action_late_mm=_mean(error[ok][:, _FIRST_ROWS:, :3]) * 1e3,
        turn_rad=_mean(error[ok][:, :_FIRST_ROWS, 5]),
        grip=_mean(grip[ok]),
        grip_near=_mean(grip[near]),
        place_mm=float(np.median(np.concatenate(places)) * 1e3),
    )


def _mean(values: np.ndarray[tuple[int, ...], np.dtype[np.float32]]) -> float:
    """The mean; NaN without values."""
    return float(values.mean()) if values.size else float("nan")
