"""pi0.5 with tiny networks: LeRobot knows only those of 3 billion weights."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Protocol
from unittest import mock

VOCABULARY = 512
"""Tokens of the tiny language models."""
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
    """pi05 with networks of 64 dimensions: LeRobot knows only those of 3 billion weights.

    Needed to make such a checkpoint, and to load it.
    """
    from lerobot.policies.pi05 import modeling_pi05

    whole, expert = (
        modeling_pi05.PaliGemmaForConditionalGenerationWithPiGemma,
        modeling_pi05.PiGemmaForCausalLM,
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
        return modeling_pi05.GemmaConfig(_WIDTH, 2, 128, 2, 1, 32)

    with (
        mock.patch.object(
            modeling_pi05, "PaliGemmaForConditionalGenerationWithPiGemma", make_whole
        ),
        mock.patch.object(modeling_pi05, "PiGemmaForCausalLM", make_expert),
        mock.patch.object(modeling_pi05, "get_gemma_config", sizes),
    ):
        yield
