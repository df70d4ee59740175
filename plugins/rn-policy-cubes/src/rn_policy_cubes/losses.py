"""The training loss: the error of the actions, and three auxiliary losses whose heads are discarded
after training.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from rn_policy_cubes.dataset import Batch
from rn_policy_cubes.labels import PLACE_WIDTH
from rn_policy_cubes.network import Thought
from rn_policy_cubes.recipe import ACTION_WIDTH, NetworkShape

ACTION_WEIGHT = (1.0, 1.0, 1.0, 0.2, 0.2, 1.5, 1.0)
_POINT, _SPOT, _PLACE = 0.5, 1.0, 1.0


class Helpers(nn.Module):
    """Auxiliary heads for training only.

    `point`: whether a visual token shows the named cube, after the first and the second layer.
    `spot`: the position of that cube, from the tokens that show it. `place`: the same, from the
    rows that the action head reads.
    """

    def __init__(self, shape: NetworkShape) -> None:
        super().__init__()
        self.point = nn.ModuleList(nn.Linear(shape.hidden, 1) for _ in range(2))
        self.spot = nn.Linear(shape.hidden, PLACE_WIDTH)
        self.place = nn.Linear(ACTION_WIDTH * shape.hidden, PLACE_WIDTH)


@dataclass(frozen=True, slots=True)
class Losses:
    """Loss terms of a step.

    Attributes:
        total: sum to be minimised.
        action: weighted L1.
        point, spot, place: losses of the auxiliary heads.
        accuracy: balanced accuracy of pointing.
        told: (pairs, 7), place predicted from the rows.
    """

    total: Tensor
    action: Tensor
    point: Tensor
    spot: Tensor
    place: Tensor
    accuracy: Tensor
    told: Tensor

    def numbers(self) -> dict[str, float]:
        """The scalars."""
        names = ("total", "action", "point", "spot", "place", "accuracy")
        return {name: float(getattr(self, name).detach()) for name in names}


def losses(thought: Thought, helpers: Helpers, batch: Batch, guidance: float = 1.0) -> Losses:
    """All terms, in float32; `guidance` is the weight of the auxiliary losses, 0 .. 1."""
    weight = thought.actions.new_tensor(ACTION_WEIGHT, dtype=torch.float32)
    error = (thought.actions.float() - batch.actions).abs() * weight
    action = (error.mean(dim=(1, 2)) * batch.known).sum() / batch.known.sum().clamp(min=1)
    points, accuracy = [], action
    for head, tokens in zip(helpers.point, thought.visual, strict=True):
        point, accuracy = pointing(head(normed(tokens))[..., 0], batch)
        points.append(point)
    point = torch.stack(points).mean()
    named = batch.shows_named
    guess = helpers.spot(normed(thought.visual[1])).float()
    spot_error = (guess - batch.place[:, None]).abs().mean(dim=-1)
    spotted = named * batch.placed[:, None]
    spot = (spot_error * spotted).sum() / spotted.sum().clamp(min=1)
    told = helpers.place(thought.rows[:, 0].float())
    place_error = (told - batch.place).abs().mean(dim=1)
    place = (place_error * batch.placed).sum() / batch.placed.sum().clamp(min=1)
    total = action + guidance * (_POINT * point + _SPOT * spot + _PLACE * place)
    return Losses(total, action, point, spot, place, accuracy, told)


def pointing(logits: Tensor, batch: Batch) -> tuple[Tensor, Tensor]:
    """Cross-entropy with equal weights of the named cube, other cubes and background; balanced
    accuracy of the former two.
    """
    logits = logits.float()
    named, other = batch.shows_named.float(), batch.shows_other.float()
    rest = (1.0 - named) * (1.0 - other)
    each = functional.binary_cross_entropy_with_logits(logits, named, reduction="none")
    parts = [(each * mask).sum() / mask.sum().clamp(min=1) for mask in (named, other, rest)]
    said = (logits > 0).float()
    right = 0.5 * (
        (said * named).sum() / named.sum().clamp(min=1)
        + ((1 - said) * other).sum() / other.sum().clamp(min=1)
    )
    return parts[0] + parts[1] + 0.5 * parts[2], right.detach()


def normed(tokens: Tensor) -> Tensor:
    return functional.rms_norm(tokens.float(), tokens.shape[-1:])
