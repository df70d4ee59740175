"""pi0 and pi0.5 with tiny networks; LeRobot itself only offers those of 3 billion weights."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from types import ModuleType
from typing import Protocol
from unittest import mock

VOCABULARY = 512
"""Vocabulary size of the tiny language models."""
_WIDTH = 64


class _Gemma(Protocol):
    vocab_size: int


class _Vision(Protocol):
    hidden_size: int
    intermediate_size: int
    num_hidden_layers: int
    num_attention_heads: int
    patch_size: int
    projection_dim: int


class _PaliGemma(Protocol):
    text_config: _Gemma
    vision_config: _Vision
    _vocab_size: int
    image_token_index: int
    projection_dim: int


@contextlib.contextmanager
def small_gemma() -> Iterator[None]:
    """Patch LeRobot so that pi0 and pi05 have networks of 64 dimensions.

    Needed to create such a checkpoint, and to load it.
    """
    from lerobot.policies.pi0 import modeling_pi0
    from lerobot.policies.pi05 import modeling_pi05

    with contextlib.ExitStack() as stack:
        for module in (modeling_pi0, modeling_pi05):
            for name, replacement in _small(module).items():
                stack.enter_context(mock.patch.object(module, name, replacement))
        yield


def _small(module: ModuleType) -> dict[str, Callable[..., object]]:
    """Replacements of the functions that create the networks of a LeRobot module, by name."""
    whole, expert = (
        module.PaliGemmaForConditionalGenerationWithPiGemma,
        module.PiGemmaForCausalLM,
    )

    def make_whole(config: _PaliGemma) -> object:
        config.text_config.vocab_size = VOCABULARY
        config._vocab_size = VOCABULARY
        config.image_token_index = VOCABULARY
        vision = config.vision_config
        vision.hidden_size, vision.intermediate_size = 32, 64
        vision.num_hidden_layers, vision.num_attention_heads = 1, 2
        vision.patch_size, vision.projection_dim = 16, _WIDTH
        config.projection_dim = _WIDTH
        return whole(config=config)

    def make_expert(config: _Gemma) -> object:
        config.vocab_size = VOCABULARY
        return expert(config=config)

    def sizes(variant: str) -> object:
        return module.GemmaConfig(_WIDTH, 2, 128, 2, 1, 32)

    return {
        "PaliGemmaForConditionalGenerationWithPiGemma": make_whole,
        "PiGemmaForCausalLM": make_expert,
        "get_gemma_config": sizes,
    }
