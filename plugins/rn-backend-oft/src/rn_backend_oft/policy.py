"""Converts a checkpoint to a runtime's model, and an observation to its request; without units and
robot.
"""

from __future__ import annotations

import functools
import time
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rn_backend_oft.components import check_components, find_component, head_shard, proprio_shard
from rn_backend_oft.constants import Constants
from rn_vla.decoding import DecodingPrompt, PolicyModel, RowsRequest
from rn_vla.openvla.checkpoint import OpenvlaCheckpoint
from rn_vla.openvla.policy import example_ids

F32 = NDArray[np.float32]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]

FAMILY = "openvla-oft"
"""Name of the model family in descriptors."""
_PLACEHOLDER_ID = 1
_STOP_ID = 2
_TAIL = 2
"""Rows after the read ones: the read-out starts one row early, at the last prompt token, so one
placeholder remains.
"""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class OftPolicy:
    """A checkpoint and the options it was trained with.

    Attributes:
        checkpoint: the base model's files.
        constants: those of the platform.
        cameras: images per observation.
        head: "l1" or "tokens".
        proprio_width: values of proprioception; 0 for none.
    """

    checkpoint: OpenvlaCheckpoint
    constants: Constants
    cameras: int
    head: Literal["l1", "tokens"]
    proprio_width: int

    def model(self, max_prompt_tokens: int, min_prompt_tokens: int = 12) -> PolicyModel:
        """The checkpoint in the form that runtimes of the family load.

        Raises:
            CheckpointError: component files are missing, would be left out, or are not implemented.
        """
        path, decoder = self.checkpoint.path, self.checkpoint.decoder
        has_head = self.head == "l1"
        check_components(path, head=has_head, proprio=bool(self.proprio_width))
        shards = list(self.checkpoint.shards)
        if has_head:
            shards.append(
                head_shard(
                    find_component(path, "action_head"), decoder, self.constants.action_width
                )
            )
        if self.proprio_width:
            shards.append(
                proprio_shard(
                    find_component(path, "proprio_projector"), decoder, self.proprio_width
                )
            )
        return PolicyModel(
            family=FAMILY,
            checkpoint=path,
            decoder=decoder,
            shards=tuple(shards),
            visual_tokens=self.cameras * self.checkpoint.vision.towers[0].patches,
            max_prompt_tokens=max_prompt_tokens + self.constants.tokens + 1,
            min_prompt_tokens=min_prompt_tokens,
            max_new_tokens=0,
            extra_tokens=1 if self.proprio_width else 0,
            example=functools.partial(self._example),
            build_front=self._build_front,
            build_back=self._build_head if has_head else None,
        )

    def request(
        self,
        *,
        text: str,
        ids: I64,
        images: tuple[U8, ...],
        pixel_values: F32,
        proprio: F32 | None,
        timeout_s: float | None = None,
        read: Literal["output", "hidden", "tokens"] | None = None,
    ) -> RowsRequest:
        """Create the request for one chunk.

        Args:
            text: the whole prompt.
            ids: int64 (n,), with the prompt's final id at the end; this method adds placeholders
                and the stop id.
            images: uint8 (H, W, 3), one per camera.
            pixel_values: float32 (cameras * channels, side, side), primary camera first.
            proprio: float32 (n,) normalised, or None for a checkpoint without.
            timeout_s: time from now after which the answer is useless.
            read: what to read; None for the default of the head.
        """
        arrays = {"pixel_values": pixel_values}
        if proprio is not None:
            arrays["proprio"] = proprio
        whole = np.concatenate(
            [ids, np.full(self.constants.tokens, _PLACEHOLDER_ID), [_STOP_ID]]
        ).astype(np.int64)
        return RowsRequest(
            prompt=DecodingPrompt(text=text, ids=whole, images=images, arrays=arrays),
            rows=self.constants.tokens,
            tail=_TAIL,
            read=read or ("output" if self.head == "l1" else "tokens"),
            deadline_s=None if timeout_s is None else time.monotonic() + timeout_s,
        )

    def _example(self, prompt_tokens: int) -> RowsRequest:
        side = self.checkpoint.vision.towers[0].image
        channels = self.cameras * 3 * len(self.checkpoint.towers)
        return self.request(
            text="",
            ids=example_ids(prompt_tokens),
            images=(np.zeros((side, side, 3), dtype=np.uint8),) * self.cameras,
            pixel_values=np.zeros((channels, side, side), dtype=np.float32),
            proprio=np.zeros(self.proprio_width, dtype=np.float32) if self.proprio_width else None,
        )

    def _build_front(self) -> object:
        from rn_backend_oft.modules import OftFront  # heavy: torch

        return OftFront(
            self.checkpoint.vision,
            placeholders=self.constants.tokens,
            proprio_width=self.proprio_width,
        )

    def _build_head(self) -> object:
        from rn_backend_oft.modules import L1Head  # heavy: torch

        return L1Head(
            hidden=self.checkpoint.decoder.hidden,
            chunk=self.constants.chunk,
            action_width=self.constants.action_width,
        )
