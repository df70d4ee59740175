"""What bends pi0's flow so that a new chunk continues the rows that are being played (see
`chunking`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from rn_backend_pi0.chunking import Prefix, end_of, guidance_weights, padded, prefix_weights


@dataclass(frozen=True, slots=True, eq=False)
class Guide:
    """Bends the flow towards the rows that are left over.

    Columns of padding are guided towards zero as well, as the checkpoints were trained.
    """

    target: Tensor
    row_weights: Tensor
    times: tuple[float, ...]
    strengths: tuple[float, ...]
    is_full: bool

    @classmethod
    def of(cls, prefix: Prefix, noise: Tensor, times: tuple[float, ...]) -> Guide | None:
        """None when no row weighs anything."""
        chunk, width = noise.shape
        weights = prefix_weights(prefix.committed, end_of(prefix), chunk, prefix.schedule)
        if not weights.any():
            return None
        return cls(
            target=torch.from_numpy(padded(prefix.rows, (chunk, width))).to(noise.device),
            row_weights=torch.from_numpy(weights.astype("float32")).to(noise.device)[:, None],
            times=times,
            strengths=guidance_weights(times, prefix.max_weight),
            is_full=prefix.jacobian == "full",
        )

    def bend(self, x: Tensor, v: Tensor, index: int) -> Tensor:
        """The velocity with the Jacobian of the estimate taken as the identity."""
        error = (self.target - (x - self.times[index] * v)) * self.row_weights
        return v - self.strengths[index] * error

    def bend_fully(self, x: Tensor, index: int, velocity: Callable[[Tensor], Tensor]) -> Tensor:
        """The velocity with the estimate's own Jacobian: one backward pass through the expert."""
        with torch.enable_grad():
            x = x.detach().requires_grad_()
            v = velocity(x)
            estimate = x - self.times[index] * v
            error = ((self.target - estimate) * self.row_weights).detach()
            (correction,) = torch.autograd.grad(estimate, x, error)
        return v.detach() - self.strengths[index] * correction


@dataclass(frozen=True, slots=True, eq=False)
class CleanPrefix:
    """Puts the committed rows in as finished ones, for checkpoints trained on such prefixes."""

    rows: Tensor
    time_term: Tensor
    chunk: int

    @classmethod
    def of(cls, prefix: Prefix, noise: Tensor, done_term: Tensor) -> CleanPrefix:
        count = min(prefix.committed, len(prefix.rows), len(noise))
        rows = padded(prefix.rows[:count], (count, noise.shape[1]))
        return cls(torch.from_numpy(rows).to(noise.device), done_term, len(noise))

    def put(self, x: Tensor) -> Tensor:
        """`x` with the clean rows in front."""
        return torch.cat([self.rows, x[len(self.rows) :]])

    def terms(self, term: Tensor) -> Tensor:
        """The time term of each row: the clean ones are at the end of the flow."""
        count = len(self.rows)
        return torch.cat([self.time_term.expand(count, -1), term.expand(self.chunk - count, -1)])
