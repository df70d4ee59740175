"""pi0.5's action expert as PyTorch modules: the flow time scales, shifts and gates every norm, and
the state is in the prompt.

The effect of a flow time on the norms depends on nothing else, so it is computed for all Euler
steps at once.
"""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rn_backend_pi0.adaptive_layers import AdaptiveGemma
from rn_backend_pi0.architecture import Pi0Dims
from rn_backend_pi0.flow import FlowNetwork
from rn_backend_pi0.layers import KeyValue, Rotary


class Pi05Network(FlowNetwork):
    """The whole model."""

    state_tokens: ClassVar[int] = 0

    def __init__(self, dims: Pi0Dims) -> None:
        super().__init__(dims)
        width = dims.expert.width
        self.expert = AdaptiveGemma(dims.expert)
        self.time_mlp_in = nn.Linear(width, width)
        self.time_mlp_out = nn.Linear(width, width)

    def fill_state(self, state: Tensor, rotary: Rotary, cache: list[KeyValue], length: int) -> None:
        """Nothing to do: the prompt contains the state."""

    def velocity(
        self,
        x: Tensor,
        term: Tensor,
        rotary: Rotary,
        cache: list[KeyValue],
        position: int,
        *,
        keep: bool = False,
    ) -> Tensor:
        """Run the expert over the action tokens, which attend to all tokens."""
        x = self.action_in_proj(x).to(self.projector.weight.dtype)
        changes = torch.split(term, 3 * self.dims.expert.width, dim=-1)
        for index, layer in enumerate(self.expert.blocks()):
            first, second = changes[2 * index : 2 * index + 2]
            normed, gate = layer.input_layernorm(x, first)
            new = layer.keys_values(normed, rotary)
            seen = self.seen_by(cache[index], new, position, keep=keep)
            x = layer.gated(x, normed, gate, rotary, seen, second)
        x, _ = self.expert.norm(x, changes[-1])
        out: Tensor = self.action_out_proj(x.float())
        return out

    def time_terms(self, times: tuple[float, ...], device: torch.device) -> Tensor:
        """Scale, shift and gate of every norm, one after the other: float32 (steps, norms x 3 x
        width). Source: openpi, the time MLP of pi0.5 and its adaptive norms.
        """
        hidden = F.silu(self.time_mlp_in(self.sinusoids(times, device)))
        condition = F.silu(self.time_mlp_out(hidden))
        return torch.cat([norm.dense(condition) for norm in self.expert.norms()], dim=1)
