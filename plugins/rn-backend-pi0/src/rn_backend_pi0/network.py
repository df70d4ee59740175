"""pi0's action expert as PyTorch modules: one token for the state, and the flow time mixed into
each action token.

The state token attends only to the prefix, so its keys and values are constant over the Euler steps
and are stored in the prefix cache.
"""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rn_backend_pi0.architecture import Pi0Dims
from rn_backend_pi0.flow import FlowNetwork, until, write
from rn_backend_pi0.layers import Gemma, KeyValue, Rotary


class Pi0Network(FlowNetwork):
    """The whole model."""

    state_tokens: ClassVar[int] = 1

    def __init__(self, dims: Pi0Dims) -> None:
        super().__init__(dims)
        width = dims.expert.width
        self.expert = Gemma(dims.expert, keys_only_last=False)
        self.state_proj = nn.Linear(dims.state, width)
        self.action_time_mlp_in = nn.Linear(2 * width, width)
        self.action_time_mlp_out = nn.Linear(width, width)

    def fill_state(self, state: Tensor, rotary: Rotary, cache: list[KeyValue], length: int) -> None:
        """Run the expert over the state token, which attends to the prefix and itself."""
        x = self.state_proj(state)[None].to(self.projector.weight.dtype)
        for index, layer in enumerate(self.expert.blocks()):
            normed = layer.input_layernorm(x)
            write(cache[index], layer.keys_values(normed, rotary), length)
            if index < self.dims.expert.depth - 1:
                x = layer(x, normed, rotary, until(cache[index], length + 1))

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
        action_weight = self.action_time_mlp_in.weight[:, : self.dims.expert.width]
        hidden = F.silu(F.linear(self.action_in_proj(x), action_weight) + term)
        x = self.action_time_mlp_out(hidden).to(self.projector.weight.dtype)
        for index, layer in enumerate(self.expert.blocks()):
            normed = layer.input_layernorm(x)
            new = layer.keys_values(normed, rotary)
            x = layer(x, normed, rotary, self.seen_by(cache[index], new, position, keep=keep))
        out: Tensor = self.action_out_proj(self.expert.norm(x).float())
        return out

    def time_terms(self, times: tuple[float, ...], device: torch.device) -> Tensor:
        """Term of each flow time before the SiLU: float32 (steps, expert width)."""
        layer = self.action_time_mlp_in
        weight = layer.weight[:, self.dims.expert.width :]
        return F.linear(self.sinusoids(times, device), weight, layer.bias)
