"""FAST, which decodes tokens to actions: a byte-pair code of rounded coefficients of a cosine
transform.

Source: arXiv 2501.09747, and the files of the published tokenizer; its remote code is not run.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from rn_backend_pi0.documents import FastProcessor
from rn_vla.checkpoint_files import MAX_TOKENIZER_BYTES, check_file, read_schema, reading
from rn_vla.rotation import F64
from roboneuron import CheckpointError, UngroundedError

if TYPE_CHECKING:
    from tokenizers import Tokenizer

FAST_DIRECTORY = "action_tokenizer"
"""Folder of the tokenizer within a checkpoint, as saved by LeRobot."""
FastLength = Literal["exact", "padded"]
_HINT = (
    "Copy processor_config.json and tokenizer.json of physical-intelligence/fast, or of the "
    "tokenizer that the model was trained with, into the checkpoint's directory "
    f"{FAST_DIRECTORY!r}, or set the option 'action_tokenizer' to their directory."
)
_UNREADABLE = "\N{REPLACEMENT CHARACTER}"


class FastTokenizer:
    """Decodes chunks of one shape.

    Args:
        tokenizer: the byte-pair code.
        processor: scale and offset of the coefficients.
        horizon: rows of a chunk.
        width: number of values of a row.
        length: "padded" fills coefficients missing at the end (the highest frequencies) with 0 and
            drops extra ones, as LeRobot does; "exact" refuses both.
    """

    def __init__(
        self,
        tokenizer: Tokenizer,
        processor: FastProcessor,
        *,
        horizon: int,
        width: int,
        length: FastLength = "exact",
    ) -> None:
        self._tokenizer, self._processor = tokenizer, processor
        self._shape, self._length = (horizon, width), length

    @property
    def size(self) -> int:
        """Number of tokens; their ids are 0 .. size - 1."""
        return int(self._tokenizer.get_vocab_size(with_added_tokens=True))

    def to_actions(self, ids: Sequence[int]) -> F64:
        """Decode token ids to normalised actions, float64 (horizon, width).

        Raises:
            UngroundedError: the ids do not encode a chunk.
        """
        text = self._tokenizer.decode(list(ids), skip_special_tokens=False)
        if _UNREADABLE in text:
            raise UngroundedError(
                "The model wrote action tokens that form no complete coefficients."
            )
        rows, columns = self._shape
        if len(text) != rows * columns and self._length == "exact":
            raise UngroundedError(
                f"The model wrote {len(text)} coefficients, a chunk has {rows} x {columns}."
            )
        values = np.array([ord(letter) for letter in text], dtype=np.float64)
        values = (values + self._processor.min_token)[: rows * columns]
        values = np.pad(values, (0, rows * columns - len(values)))
        return cosines(rows).T @ (values.reshape(rows, columns) / self._processor.scale)


def cosines(count: int) -> F64:
    """Orthonormal matrix (count, count) of the cosine transform of type II."""
    k, n = np.arange(count)[:, None], np.arange(count)[None, :]
    matrix = np.sqrt(2.0 / count) * np.cos(np.pi * (2 * n + 1) * k / (2 * count))
    matrix[0] /= np.sqrt(2.0)
    return np.asarray(matrix, dtype=np.float64)


def load_fast_tokenizer(
    checkpoint: Path, path: Path | None, *, horizon: int, width: int, length: FastLength
) -> FastTokenizer:
    """Load the action tokenizer from `path`, else from the checkpoint's own directory.

    Raises:
        CheckpointError: it is missing, cannot be read, or is for chunks of another shape.
    """
    from tokenizers import Tokenizer  # heavy

    directory = path or checkpoint / FAST_DIRECTORY
    if not directory.is_dir():
        raise CheckpointError(f"There is no action tokenizer at {directory}.", hint=_HINT)
    source = directory / "processor_config.json"
    processor = read_schema(source, FastProcessor)
    said = (processor.time_horizon or horizon, processor.action_dim or width)
    if said != (horizon, width):
        raise CheckpointError(
            f"{source} is for chunks of {said[0]} x {said[1]}, the model has {horizon} x {width}."
        )
    file = directory / "tokenizer.json"
    check_file(file, MAX_TOKENIZER_BYTES)
    with reading(file, "a tokenizer"):
        tokenizer = Tokenizer.from_str(file.read_bytes().decode("utf-8"))
    fast = FastTokenizer(tokenizer, processor, horizon=horizon, width=width, length=length)
    if fast.size > processor.vocab_size:
        raise CheckpointError(
            f"{file} has {fast.size} tokens, {source.name} says {processor.vocab_size}.", hint=_HINT
        )
    return fast
