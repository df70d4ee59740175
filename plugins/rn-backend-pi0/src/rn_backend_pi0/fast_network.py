"""pi0-FAST as PyTorch modules: the language model itself generates the actions, token by token."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional as F

from rn_backend_pi0.architecture import Pi0Dims
from rn_backend_pi0.flow import part_of, until, write
from rn_backend_pi0.layers import KeyValue, Rotary
from rn_backend_pi0.prefix import PrefixNetwork


class FastNetwork(PrefixNetwork):
    """The whole model. The token embedding also serves as the output head."""

    def __init__(self, dims: Pi0Dims) -> None:
        super().__init__(dims, keys_only_last=False)

    @torch.inference_mode()
    def write_tokens(
        self,
        pixels: Tensor,
        token_ids: Tensor,
        *,
        given: Sequence[int],
        allowed: Tensor,
        stop: int,
        most: int,
    ) -> tuple[list[int], int]:
        """Generate tokens greedily, restricted to the allowed ones.

        Args:
            pixels: float32 (cameras >= 1, 3, H, W) in -1..1, present cameras only, in slot order.
            token_ids: int64 (n,), the prompt without padding.
            given: first ids of the answer, as in all answers of the training data.
            allowed: int64 (m,), ids allowed after that, including the stop.
            stop: the id that ends the answer.
            most: largest number of tokens after `given`.

        Returns:
            The ids after `given`, without the stop, and the number of them (the stop included) for
            which another token of the vocabulary was likelier than every allowed one.
        """
        x = self.embed_prefix(pixels.to(self.projector.weight.dtype), token_ids)
        length = x.shape[0]
        rotary = self.rotary_of(length + len(given) + most, x.device, x.dtype)
        cache: list[KeyValue] = []
        room = len(given) + most
        for layer in self.prefix.blocks():
            normed = layer.input_layernorm(x)
            new = layer.keys_values(normed, part_of(rotary, 0, length))
            cache.append((_with_room(new[0], room), _with_room(new[1], room)))
            x = layer(x, normed, part_of(rotary, 0, length), new)
        for token in given:
            x = self._next(token, length, rotary, cache)
            length += 1
        written: list[int] = []
        outside = 0
        for _ in range(most):
            scores = F.linear(self.prefix.norm(x[-1:]), self.embedding.weight)[0]
            token = int(allowed[scores[allowed].argmax()])
            outside += int(scores.argmax()) != token
            if token == stop:
                break
            written.append(token)
            x = self._next(token, length, rotary, cache)
            length += 1
        return written, outside

    def _next(self, token: int, position: int, rotary: Rotary, cache: list[KeyValue]) -> Tensor:
        """Hidden state (1, width) of one more token, which attends to all tokens before it."""
        x = self.embed_text(torch.tensor([token], device=self.embedding.weight.device))
        here = part_of(rotary, position, position + 1)
        for index, layer in enumerate(self.prefix.blocks()):
            normed = layer.input_layernorm(x)
            write(cache[index], layer.keys_values(normed, here), position)
            x = layer(x, normed, here, until(cache[index], position + 1))
        return x


def _with_room(cached: Tensor, room: int) -> Tensor:
    return F.pad(cached, (0, 0, 0, room))
