"""The words the model was trained with, as text and as token ids."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray
from tokenizers import Tokenizer

from roboneuron.errors import CheckpointError

I64 = NDArray[np.int64]

BOS_ID = 1
"""First id of every prompt."""
FINAL_ID = 29871
"""The lone word boundary that every prompt ends with; the tokenizer alone does not always give it."""

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
    """Instruction -> prompt text and ids, with the checkpoint's own tokenizer."""

    def __init__(self, tokenizer_file: Path, template: str) -> None:
        """Read the tokenizer. Raises CheckpointError when the file is absent, damaged or adds no first id."""
        if not tokenizer_file.is_file():
            raise CheckpointError(
                f"{tokenizer_file} does not exist.", hint="Copy tokenizer.json of the original checkpoint there."
            )
        try:
            self._tokenizer = Tokenizer.from_file(str(tokenizer_file))
        except Exception as error:  # the library raises nothing narrower
            raise CheckpointError(f"{tokenizer_file} cannot be read as a tokenizer: {error}") from error
        self._template = _TEMPLATES[template]
        ids = self._tokenizer.encode(self.to_text("x")).ids
        if not ids or ids[0] != BOS_ID:
            raise CheckpointError(f"{tokenizer_file} begins a prompt with ids {ids[:3]}, expected {BOS_ID} first.")

    def to_text(self, instruction: str) -> str:
        """The whole prompt; the instruction is lower-cased, as in training."""
        return self._template.format(instruction=instruction.lower())

    def to_ids(self, text: str) -> I64:
        """Token ids int64 (n,), beginning with BOS_ID and ending with FINAL_ID."""
        return end_prompt(np.array(self._tokenizer.encode(text).ids, dtype=np.int64))


def end_prompt(ids: I64) -> I64:
    """Append FINAL_ID unless the ids already end with it."""
    return ids if ids[-1] == FINAL_ID else np.append(ids, FINAL_ID)
