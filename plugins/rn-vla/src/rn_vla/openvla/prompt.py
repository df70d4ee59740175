"""The prompt used in training, as text and as token ids."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray
from tokenizers import Tokenizer, models, normalizers, processors

from rn_vla.checkpoint_files import MAX_TOKENIZER_BYTES, check_file, reading
from roboneuron import CheckpointError

I64 = NDArray[np.int64]

BOS_ID = 1
"""First id of every prompt."""
FINAL_ID = 29871
"""The single word boundary that ends every prompt; the tokenizer alone does not always produce
it.
"""

_ORIGINAL = "Copy tokenizer.json of the original checkpoint there."
# Source: OpenVLA, prompt builders of the two releases.
_TEMPLATES: Mapping[str, str] = MappingProxyType(
    {
        "v02": "In: What action should the robot take to {instruction}?\nOut:",
        "v01": (
            "A chat between a curious user and an artificial intelligence assistant. "
            "The assistant gives helpful, detailed, and polite answers to the user's questions. "
            "USER: What action should the robot take to {instruction}? ASSISTANT:"
        ),
    }
)


class PromptEncoder:
    """Encodes an instruction as prompt text and ids, with the checkpoint's own tokenizer."""

    def __init__(self, tokenizer_file: Path, template: str, *, base: int, embeddings: int) -> None:
        """Read the tokenizer.

        Args:
            tokenizer_file: tokenizer.json.
            template: "v02" or "v01".
            base: number of ids without added ones, from the checkpoint's configuration; action
                tokens end there.
            embeddings: rows of the model's embedding; an id beyond them has no meaning and would
                corrupt a GPU's context.

        Raises:
            CheckpointError: the file is missing, damaged, of another model, or adds no first id.
        """
        check_file(tokenizer_file, MAX_TOKENIZER_BYTES)
        with reading(tokenizer_file, "a tokenizer"):
            self._tokenizer = Tokenizer.from_str(tokenizer_file.read_bytes().decode("utf-8"))
            # Settings of the file would truncate or pad the instruction silently.
            self._tokenizer.no_truncation()
            self._tokenizer.no_padding()
            self._template = _TEMPLATES[template]
            self._source, self._embeddings = tokenizer_file, embeddings
            highest = max(FINAL_ID, *self._tokenizer.get_vocab(with_added_tokens=True).values())
            without_added = self._tokenizer.get_vocab_size(with_added_tokens=False)
            ids = self._tokenizer.encode(self.to_text("x")).ids
        if highest >= embeddings:
            raise CheckpointError(
                f"{tokenizer_file} knows the id {highest}, the model has {embeddings} embeddings.",
                hint=_ORIGINAL,
            )
        if without_added != base:
            raise CheckpointError(
                f"{tokenizer_file} has {without_added} ids, config.json says {base} (vocab_size "
                "less "
                "pad_to_multiple_of); action tokens are counted from there.",
                hint=_ORIGINAL,
            )
        if not ids or ids[0] != BOS_ID:
            raise CheckpointError(
                f"{tokenizer_file} begins a prompt with ids {ids[:3]}, expected {BOS_ID} first.",
                hint=_ORIGINAL,
            )

    def to_text(self, instruction: str) -> str:
        """The whole prompt; the instruction is lower-cased, as in training."""
        return self._template.format(instruction=instruction.lower())

    def shortest(self) -> int:
        """Number of tokens of the template with an instruction of one letter. Raises
        CheckpointError.
        """
        return int(self.to_ids(self.to_text("a")).size)

    def to_ids(self, text: str) -> I64:
        """Token ids int64 (n,), beginning with BOS_ID and ending with FINAL_ID.

        Raises:
            CheckpointError: the tokenizer produces an id that the model does not have.
        """
        with reading(self._source, "a tokenizer"):
            ids = end_prompt(np.array(self._tokenizer.encode(text).ids, dtype=np.int64))
        if not 0 <= ids.min() <= ids.max() < self._embeddings:
            raise CheckpointError(
                f"{self._source} gives the id {ids.max()}, the model has {self._embeddings} "
                "embeddings.",
                hint=_ORIGINAL,
            )
        return ids


def end_prompt(ids: I64) -> I64:
    """Append FINAL_ID unless the ids already end with it."""
    return ids if ids.size and ids[-1] == FINAL_ID else np.append(ids, FINAL_ID)


def save_tokenizer(
    path: Path, vocabulary: dict[str, int], merges: Sequence[tuple[str, str]]
) -> None:
    """Write a Llama-like byte-pair encoding of these ids and merges, which may repeat."""
    tokenizer = Tokenizer(
        models.BPE(
            vocab=vocabulary,
            merges=list(dict.fromkeys(merges)),
            unk_token="<unk>",
            fuse_unk=True,
            byte_fallback=True,
        )
    )
    tokenizer.normalizer = normalizers.Sequence(
        [normalizers.Prepend("▁"), normalizers.Replace(" ", "▁")]
    )
    tokenizer.post_processor = processors.TemplateProcessing(
        single="<s> $A", special_tokens=[("<s>", BOS_ID)]
    )
    tokenizer.save(str(path))
