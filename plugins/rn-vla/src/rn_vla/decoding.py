"""Interface between a language-model backend and a runtime: the model at `load`, one request at
`run`.

numpy only, so that a backend, an in-process runtime and a served one agree without sharing an
engine. It is independent of model families; a runtime's descriptor lists the families and kinds of
request that it supports.

An in-process runtime uses the weights, the ids and the prepared arrays, a served one the text and
the images. Both give the same reply.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol, TypeAlias, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from rn_vla.pruning import PrunableDecoder
from roboneuron import Acceleration, Runtime, freeze

F32 = NDArray[np.float32]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]


@dataclass(frozen=True, kw_only=True, slots=True)
class DecoderShape:
    """A Llama-shaped decoder: RMSNorm, rotary positions, gated SiLU, no biases, untied output head.

    Attributes:
        hidden, intermediate: widths of the residual stream and of the gated layer.
        layers, heads, key_value_heads: counts; `heads` is a multiple of `key_value_heads`.
        vocabulary: rows of the embedding and of the output head.
        norm_epsilon, rope_theta: constants of RMSNorm and of the rotary positions.
        max_positions: longest sequence.
    """

    hidden: int
    intermediate: int
    layers: int
    heads: int
    key_value_heads: int
    vocabulary: int
    norm_epsilon: float
    rope_theta: float
    max_positions: int

    @property
    def head_width(self) -> int:
        """Values per head."""
        return self.hidden // self.heads


@dataclass(frozen=True, kw_only=True, slots=True)
class Weight:
    """One tensor of a checkpoint file.

    Attributes:
        shape: shape in the file.
        target: its destination in an in-process runtime: "decoder.<name in the Hugging Face Llama
            layout>", "front.<parameter>" or "back.<parameter>"; empty for a tensor on disk that is
            never used.
    """

    shape: tuple[int, ...]
    target: str


@dataclass(frozen=True, kw_only=True, slots=True)
class Shard:
    """One weight file, `.safetensors` or a state dictionary saved by torch (`.pt`).

    Attributes:
        path: the file.
        weights: exactly the tensors it holds, by their names in the file.
    """

    path: Path
    weights: Mapping[str, Weight]


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class DecodingPrompt:
    """Input of the model, in both forms. Neither side writes to its arrays.

    Attributes:
        text: the whole prompt, for a served engine.
        ids: int64 (n,), the same as token ids, first and last special ids included.
        images: uint8 (H, W, 3) RGB, one per camera in the model's order, as for the model's own
            processor.
        arrays: float32 inputs of the front by name ("pixel_values" ...), without batch dimension.
    """

    text: str
    ids: I64
    images: tuple[U8, ...]
    arrays: Mapping[str, F32]


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class TokenRequest:
    """Decode greedily after the prompt, causally. Capability word: "token-decode".

    Attributes:
        prompt: input of the model.
        max_new_tokens: exact number of decoded tokens; there is no end token.
        deadline_s: `time.monotonic()` after which the answer is useless; None for no deadline.
        with_logits: also return the logits of the first token (a served runtime may refuse).
    """

    prompt: DecodingPrompt
    max_new_tokens: int
    deadline_s: float | None = None
    with_logits: bool = False


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class TokenReply:
    """Answer to a `TokenRequest`.

    Attributes:
        tokens: int64 (max_new_tokens,).
        logits: float32 (vocabulary,) at the last prompt position, or None if not requested.
        metrics: in milliseconds or tokens.
        note: one short sentence if the fast path was not used; otherwise empty.
    """

    tokens: I64
    logits: F32 | None = None
    metrics: Mapping[str, float] = field(default_factory=dict)
    note: str = ""

    def __post_init__(self) -> None:
        freeze(self, "tokens", dtype=np.int64)
        freeze(self, "logits", dtype=np.float32)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class RowsRequest:
    """One pass in which every position attends to all others; read some rows near the end.
    Capability word: "bidirectional-hidden".

    Attributes:
        prompt: input of the model; its ids include the placeholders.
        rows: number of rows to read.
        tail: number of rows after them.
        read: "output" the back module's result, "hidden" the rows after the final norm, "tokens"
            their best ids.
        deadline_s: as in `TokenRequest`.
    """

    prompt: DecodingPrompt
    rows: int
    tail: int
    read: Literal["output", "hidden", "tokens"] = "output"
    deadline_s: float | None = None


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class RowsReply:
    """Answer to a `RowsRequest`.

    Attributes:
        values: float32, the back module's shape, or (rows, hidden), or (rows,) ids.
        metrics, note: as in `TokenReply`.
    """

    values: F32
    metrics: Mapping[str, float] = field(default_factory=dict)
    note: str = ""

    def __post_init__(self) -> None:
        freeze(self, "values", dtype=None)


Request: TypeAlias = TokenRequest | RowsRequest
"""Requests of `Runtime.run` for the families of language-model policies."""
Reply: TypeAlias = TokenReply | RowsReply
"""Replies to them."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class PolicyModel:
    """A language-model policy, passed by a backend to `Runtime.load`.

    Attributes:
        family: family name in the descriptors.
        checkpoint: its directory; a served runtime compares the name with the server's.
        decoder: shape of the language model.
        shards: every weight file; an in-process runtime reads them one by one.
        visual_tokens: number of positions after the first one that hold image patches.
        max_prompt_tokens: longest `DecodingPrompt.ids`.
        min_prompt_tokens: shortest prompt in the count of `example`: the template around an
            instruction of one word.
        max_new_tokens: largest number of tokens decoded by any request; 0 for families that decode
            none.
        extra_tokens: positions beyond `DecodingPrompt.ids` and `visual_tokens` that the front adds,
            directly after the latter.
        example: returns a request with that number of prompt ids, for warming up.
        build_front: heavy; returns a torch module called as `front(arrays, ids, embed)` that
            returns the decoder's input (b, positions, hidden); `embed` looks ids up. Its parameters
            are the targets "front.*". Among several prompts, the ids of shorter ones are padded
            after the first id.
        build_back: likewise, for the module applied to the read rows (b, rows, hidden); None for
            none.
    """

    family: str
    checkpoint: Path
    decoder: DecoderShape
    shards: tuple[Shard, ...]
    visual_tokens: int
    max_prompt_tokens: int
    max_new_tokens: int
    example: Callable[[int], Request]
    build_front: Callable[[], Any]
    build_back: Callable[[], Any] | None = None
    extra_tokens: int = 0
    min_prompt_tokens: int = 12


LlamaRuntime: TypeAlias = Runtime[PolicyModel, Request, Reply, PrunableDecoder]
"""A runtime of Llama-shaped decoders that answers both kinds of request."""
TokenRuntime: TypeAlias = Runtime[PolicyModel, TokenRequest, Reply, PrunableDecoder]
"""A runtime that answers at least `TokenRequest`, as needed by backends of the family "openvla"."""
RowsRuntime: TypeAlias = Runtime[PolicyModel, RowsRequest, Reply, PrunableDecoder]
"""A runtime that answers at least `RowsRequest`, as needed by backends of the family
"openvla-oft".
"""


@runtime_checkable
class BatchRuntime(Protocol):
    """Optional method of a runtime, besides `run`."""

    def run_batch(self, requests: Sequence[RowsRequest]) -> Sequence[Reply]:
        """One reply for each request, in their order, from one pass; raises the errors of `run`,
        for all of them.
        """
        ...


LlamaAcceleration: TypeAlias = Acceleration[PrunableDecoder]
"""An acceleration of Llama-shaped decoders."""


class LlamaAccelerationChanger(Protocol):
    """A runtime of Llama-shaped decoders that can change the acceleration of a loaded model."""

    def set_acceleration(self, acceleration: LlamaAcceleration | None) -> None:
        """Execute later calls of `run` with this preset, or with none; between two of them, in
        milliseconds.
        """
        ...
