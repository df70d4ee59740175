"""The training loss of the flow policy: flow matching, and auxiliary losses whose heads are
discarded after training.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from rn_policy_cubes.dataset import Batch
from rn_policy_cubes.flow.network import FlowPrefix, FlowThought
from rn_policy_cubes.flow.recipe import ACTION_MEAN, ACTION_STD, FlowShape
from rn_policy_cubes.labels import PLACE_WIDTH
from rn_policy_cubes.losses import normed, pointing
from rn_policy_cubes.recipe import ACTION_SCALE

_DIMENSION_WEIGHT = (1.0, 1.0, 1.0, 0.2, 0.2, 1.0, 0.7)
_POINT, _SPOT, _PLACE = 0.5, 1.0, 1.0
_SHORTEST_TIME = 0.001


class FlowHelpers(nn.Module):
    """Auxiliary heads for training only, as in the other policy: `point` and `spot` read visual
    tokens, `place` the state's token, `place_of_rows` the action tokens.
    """

    def __init__(self, shape: FlowShape) -> None:
        super().__init__()
        self.point = nn.ModuleList(nn.Linear(shape.hidden, 1) for _ in range(2))
        self.spot = nn.Linear(shape.hidden, PLACE_WIDTH)
        self.place = nn.Linear(shape.expert, PLACE_WIDTH)
        self.place_of_rows = nn.Linear(shape.expert, PLACE_WIDTH)


@dataclass(frozen=True, slots=True)
class FlowTask:
    """Noise and flow times of a batch.

    Attributes:
        noise: float32 (pairs, samples, FLOW_ROWS, 7).
        times: float32 (pairs, samples).
    """

    noise: Tensor
    times: Tensor

    @classmethod
    def draw(cls, batch: Batch, samples: int, seed: int) -> FlowTask:
        """Times are distributed as Beta(1.5, 1), with one in each of `samples` equally likely
        intervals, and limited to 0.001 .. 1.

        Source: openpi, models/pi0.py, compute_loss (distribution and limits). The inverse of that
        distribution function is u^(2/3).
        """
        pairs, rows, width = batch.actions.shape
        random = torch.Generator().manual_seed(seed)
        noise = torch.randn(pairs, samples, rows, width, generator=random)
        share = (torch.rand(pairs, samples, generator=random) + torch.arange(samples)) / samples
        times = share ** (2 / 3) * (1 - _SHORTEST_TIME) + _SHORTEST_TIME
        device = batch.actions.device
        return cls(noise.to(device), times.to(device))

    def noisy(self, batch: Batch) -> Tensor:
        """The point of the flow at each time, of `noise`'s shape."""
        times = self.times[:, :, None, None]
        return times * self.noise + (1 - times) * to_network(batch.actions)[:, None]


@dataclass(frozen=True, slots=True)
class FlowLosses:
    """Loss terms of a step.

    Attributes:
        total: sum to be minimised.
        flow: weighted squared error of the velocity.
        point, spot, place: losses of the auxiliary heads.
        accuracy: balanced accuracy of pointing.
    """

    total: Tensor
    flow: Tensor
    point: Tensor
    spot: Tensor
    place: Tensor
    accuracy: Tensor

    def numbers(self) -> dict[str, float]:
        """The scalars."""
        names = ("total", "flow", "point", "spot", "place", "accuracy")
        return {name: float(getattr(self, name).detach()) for name in names}


def to_network(actions: Tensor) -> Tensor:
    """Actions as labelled, in units of ACTION_SCALE, in the network's units (mean 0, spread 1)."""
    scale = actions.new_tensor((*ACTION_SCALE, 1.0))
    return (actions * scale - actions.new_tensor(ACTION_MEAN)) / actions.new_tensor(ACTION_STD)


def from_network(actions: Tensor) -> Tensor:
    """Actions (..., 7) in the network's units as moves [m], rotation vectors [rad], opening."""
    return actions * actions.new_tensor(ACTION_STD) + actions.new_tensor(ACTION_MEAN)


def flow_losses(
    prefix: FlowPrefix,
    thought: FlowThought,
    helpers: FlowHelpers,
    batch: Batch,
    task: FlowTask,
) -> FlowLosses:
    """All terms, in float32. The velocity to be learnt is noise - actions."""
    weight = thought.velocity.new_tensor(_DIMENSION_WEIGHT)
    wanted = task.noise - to_network(batch.actions)[:, None]
    error = (thought.velocity - wanted).square() * weight
    flow = (error.mean(dim=(1, 2, 3)) * batch.known).sum() / batch.known.sum().clamp(min=1)
    points, accuracy = [], flow
    for head, tokens in zip(helpers.point, prefix.visual, strict=True):
        point, accuracy = pointing(head(normed(tokens))[..., 0], batch)
        points.append(point)
    point = torch.stack(points).mean()
    guess = helpers.spot(normed(prefix.visual[1])).float()
    spot_error = (guess - batch.place[:, None]).abs().mean(dim=-1)
    spotted = batch.shows_named * batch.placed[:, None]
    spot = (spot_error * spotted).sum() / spotted.sum().clamp(min=1)
    told = helpers.place(normed(thought.state))
    told_rows = helpers.place_of_rows(normed(thought.rows))
    place_error = (told - batch.place).abs().mean(dim=1)
    place_error = place_error + (told_rows - batch.place[:, None]).abs().mean(dim=(1, 2))
    place = (place_error * batch.placed).sum() / batch.placed.sum().clamp(min=1) / 2
    total = flow + _POINT * point + _SPOT * spot + _PLACE * place
    return FlowLosses(total, flow, point, spot, place, accuracy)
