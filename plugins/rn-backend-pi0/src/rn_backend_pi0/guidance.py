"""Guidance of pi0's flow so that a new chunk continues the rows being executed (see `chunking`)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from rn_backend_pi0.chunking import Prefix, end_of, guidance_weights, padded, prefix_weights


@dataclass(frozen=True, slots=True, eq=False)
class Guide:
    """Guides the flow towards the left-over rows.

    Columns of padding are guided towards zero as well, as in the checkpoints' training.
    """

    target: Tensor
    row_weights: Tensor
    times: tuple[float, ...]
    strengths: tuple[float, ...]
    is_full: bool

    @classmethod
    def of(cls, prefix: Prefix, noise: Tensor, times: tuple[float, ...]) -> Guide | None:
        """Create the guide; None if no row has a weight."""
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
        """The guided velocity, with the Jacobian of the estimate approximated by the identity."""
        error = (self.target - (x - self.times[index] * v)) * self.row_weights
        return v - self.strengths[index] * error

    def bend_fully(self, x: Tensor, index: int, velocity: Callable[[Tensor], Tensor]) -> Tensor:
        """The guided velocity with the exact Jacobian: one backward pass through the expert."""
        with torch.enable_grad():
            x = x.detach().requires_grad_()
            v = velocity(x)
            estimate = x - self.times[index] * v
            error = ((self.target - estimate) * self.row_weights).detach()
            (correction,) = torch.autograd.grad(estimate, x, error)
        return v.detach() - self.strengths[index] * correction


@dataclass(frozen=True, slots=True, eq=False)
class CleanPrefix:
    """Inserts the committed rows as finished ones, for checkpoints trained on such prefixes."""

    rows: Tensor
    time_term: Tensor
    chunk: int

    @classmethod
    def of(cls, prefix: Prefix, noise: Tensor, done_term: Tensor) -> CleanPrefix:
        count = min(prefix.committed, len(prefix.rows), len(noise))
        rows = padded(prefix.rows[:count], (count, noise.shape[1]))
        return cls(torch.from_numpy(rows).to(noise.device), done_term, len(noise))

    def put(self, x: Tensor) -> Tensor:
        """`x` with its first rows replaced by the clean ones."""
        return torch.cat([self.rows, x[len(self.rows) :]])

    def terms(self, term: Tensor) -> Tensor:
        """The time term of each row; the clean rows get that of the end of the flow."""
        count = len(self.rows)
        return torch.cat([self.time_term.expand(count, -1), term.expand(self.chunk - count, -1)])
