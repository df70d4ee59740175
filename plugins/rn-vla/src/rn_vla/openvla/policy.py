"""Converts a checkpoint to a runtime's model, and an observation to its request; without units and
robot.
"""

from __future__ import annotations

import functools
import time

import numpy as np
from numpy.typing import NDArray

from rn_vla.decoding import DecodingPrompt, PolicyModel, TokenRequest
from rn_vla.openvla.bins import ActionBins
from rn_vla.openvla.checkpoint import OpenvlaCheckpoint
from rn_vla.openvla.prompt import BOS_ID, FINAL_ID, PromptEncoder

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]

FAMILY = "openvla"
"""Name of the model family in descriptors."""


def policy_model(
    checkpoint: OpenvlaCheckpoint,
    *,
    action_width: int,
    max_prompt_tokens: int,
    min_prompt_tokens: int = 12,
) -> PolicyModel:
    """The checkpoint in the form that runtimes of the family load."""
    return PolicyModel(
        family=FAMILY,
        checkpoint=checkpoint.path,
        decoder=checkpoint.decoder,
        shards=checkpoint.shards,
        visual_tokens=checkpoint.vision.towers[0].patches,
        max_prompt_tokens=max_prompt_tokens,
        min_prompt_tokens=min_prompt_tokens,
        max_new_tokens=action_width,
        example=functools.partial(_example, checkpoint, action_width),
        build_front=functools.partial(_build_front, checkpoint),
    )


def token_request(
    *,
    text: str,
    ids: I64,
    image: U8,
    pixel_values: F32,
    action_width: int,
    timeout_s: float | None = None,
) -> TokenRequest:
    """Create the request for one action.

    Args:
        text: the whole prompt.
        ids: int64 (n,), ending with FINAL_ID.
        image: uint8 (H, W, 3), the image of the pixels.
        pixel_values: float32 (channels, side, side).
        action_width: values per action.
        timeout_s: time from now after which the answer is useless.
    """
    return TokenRequest(
        prompt=DecodingPrompt(
            text=text, ids=ids, images=(image,), arrays={"pixel_values": pixel_values}
        ),
        max_new_tokens=action_width,
        deadline_s=None if timeout_s is None else time.monotonic() + timeout_s,
    )


def action_bins(checkpoint: OpenvlaCheckpoint) -> ActionBins:
    """The checkpoint's action tokens."""
    return ActionBins(checkpoint.action_bins, checkpoint.token_vocabulary)


def prompt_encoder(checkpoint: OpenvlaCheckpoint, template: str) -> PromptEncoder:
    """The checkpoint's tokenizer, checked against its configuration. Raises CheckpointError."""
    return PromptEncoder(
        checkpoint.path / "tokenizer.json",
        template,
        base=checkpoint.token_vocabulary,
        embeddings=checkpoint.decoder.vocabulary,
    )


def example_ids(count: int) -> I64:
    """Ids of a meaningless prompt with `count` tokens."""
    return np.array([BOS_ID] + [FINAL_ID] * (count - 1), dtype=np.int64)


def _example(checkpoint: OpenvlaCheckpoint, action_width: int, prompt_tokens: int) -> TokenRequest:
    side = checkpoint.vision.towers[0].image
    return token_request(
        text="",
        ids=example_ids(prompt_tokens),
        image=np.zeros((side, side, 3), dtype=np.uint8),
        pixel_values=np.zeros((3 * len(checkpoint.towers), side, side), dtype=np.float32),
        action_width=action_width,
    )


def _build_front(checkpoint: OpenvlaCheckpoint) -> object:
    from rn_vla.openvla.front import OpenVlaFront  # heavy: torch

    return OpenVlaFront(checkpoint.vision)
