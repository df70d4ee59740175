"""A loaded pi0-FAST: maps images and token ids to action tokens, and these to normalised
actions.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from rn_backend_pi0.checkpoint import Pi0Checkpoint
from rn_backend_pi0.chunking import Prefix
from rn_backend_pi0.fast_network import FastNetwork
from rn_backend_pi0.fast_tokens import FastTokenizer
from rn_backend_pi0.model import F32, Pi0Model
from rn_backend_pi0.prompt import ANSWER, STOP, InstructionEncoder
from roboneuron import CheckpointError, UngroundedError


class FastModel(Pi0Model):
    """The weights on a device, with the action tokenizer.

    Args:
        checkpoint: description of the checkpoint.
        prompt: tokenizer of the language model.
        actions: tokenizer of the actions.
        max_outside_share: largest accepted fraction of an answer's tokens for which the model
            prefers another token over every action token.
        settings: those of `Pi0Model`.

    Raises:
        CheckpointError: the action tokens do not fit into the vocabulary, or as `Pi0Model`.
        ConfigurationError: as `Pi0Model`.
    """

    def __init__(
        self,
        checkpoint: Pi0Checkpoint,
        prompt: InstructionEncoder,
        actions: FastTokenizer,
        *,
        max_outside_share: float,
        **settings: Any,
    ) -> None:
        fast, stop = checkpoint.fast, prompt.token_ids(STOP)
        if fast is None or len(stop) != 1:
            raise CheckpointError(
                f"{checkpoint.directory}: the tokenizer has no single token for {STOP!r}."
            )
        self._actions, self._most = actions, fast.most_tokens
        self._given, self._stop = prompt.token_ids(ANSWER), stop[0]
        self._last = prompt.last_id - fast.skip_tokens
        self._max_outside_share, self._is_warming = max_outside_share, False
        first = self._last - actions.size + 1
        if first <= self._stop:
            raise CheckpointError(
                f"{checkpoint.directory}: {actions.size} action tokens do not fit into a "
                f"vocabulary of {prompt.last_id + 1}."
            )
        super().__init__(checkpoint, **settings)
        ids = [self._stop, *range(first, self._last + 1)]
        self._allowed = torch.tensor(ids, dtype=torch.int64, device=self.device)

    def warm_up(self, images: int, token_count: int, state_width: int) -> float:
        """As `Pi0Model.warm_up`; the tokens for grey images need not form a chunk."""
        self._is_warming = True
        try:
            return super().warm_up(images, token_count, state_width)
        finally:
            self._is_warming = False

    def _answer(
        self, pixels: Tensor, token_ids: Tensor, state: F32, noise: F32, prefix: Prefix | None
    ) -> F32:
        network = self._network
        assert isinstance(network, FastNetwork), type(network)
        written, outside = network.write_tokens(
            pixels,
            token_ids,
            given=self._given,
            allowed=self._allowed,
            stop=self._stop,
            most=self._most,
        )
        if self._is_warming:
            return np.zeros(self.noise_shape, dtype=np.float32)
        count = len(written) + 1
        if outside > self._max_outside_share * count:
            raise UngroundedError(
                f"For {outside} of {count} tokens of the answer the model finds another one "
                f"likelier than every action token; at most a share of "
                f"{self._max_outside_share:g} is let through (max_outside_share)."
            )
        actions = self._actions.to_actions([self._last - token for token in written])
        return actions.astype(np.float32)
