"""Encoding of instructions, and of pi0.5's state, to token ids, with a local tokenizer.json and no
network access.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rn_backend_pi0.architecture import Variant
from rn_backend_pi0.checkpoint import Family
from rn_vla.checkpoint_files import MAX_TOKENIZER_BYTES, check_file, reading
from rn_vla.normalisation import Values
from roboneuron import CheckpointError, UngroundedError

if TYPE_CHECKING:
    from tokenizers import Tokenizer

TOKENIZER_FILE = "tokenizer.json"
_BOS = "<bos>"
_WHERE = (
    "Copy tokenizer.json of google/paligemma-3b-pt-224 (its licence must be accepted once) into "
    "the checkpoint "
    "directory, or set the option 'tokenizer' to its path."
)


ANSWER = "Action: "
"""Text before the actions."""
STOP = "|"
"""Text that ends pi0-FAST's answer."""
_EDGES = np.linspace(-1.0, 1.0, 257)[:-1]
"""Lower edges of the 256 bins of the state. Source: openpi, PaligemmaTokenizer."""


def state_bins(state: Values) -> list[int]:
    """Bins of a normalised state (n,) for the prompt: 0..255 over -1..1, -1 below; values outside
    are not clipped first.
    """
    bins: list[int] = (np.digitize(state, _EDGES) - 1).tolist()
    return bins


class InstructionEncoder:
    """Encodes instructions as in training, without padding: for pi0 BOS, the text and a newline
    token, for the others BOS and a text with the state; pi0-FAST's answer begins with another BOS.

    Padding occupies no positions and is masked in the original implementations, so leaving it out
    changes nothing.
    """

    def __init__(
        self,
        tokenizer: Tokenizer,
        *,
        family: Family,
        max_tokens: int,
        vocabulary: int,
        source: str,
        variant: Variant = "pi0",
    ) -> None:
        bos, newline = (
            tokenizer.token_to_id(_BOS),
            tokenizer.encode("\n", add_special_tokens=False).ids,
        )
        if bos is None or len(newline) != 1:
            raise CheckpointError(
                f"{source} is no PaliGemma tokenizer: it lacks {_BOS} or has no single token for "
                "a newline.",
                hint=_WHERE,
            )
        self._tokenizer, self._family, self._variant = tokenizer, family, variant
        self._bos, self._newline = bos, newline[0]
        self._max_tokens, self._vocabulary, self._source = max_tokens, vocabulary, source
        highest = max(bos, *newline, *tokenizer.get_vocab(with_added_tokens=True).values())
        if highest >= vocabulary:
            raise CheckpointError(
                f"{source} knows the id {highest}, the model has {vocabulary} embeddings.",
                hint=_WHERE,
            )

    def token_ids(self, text: str) -> list[int]:
        """Token ids of an unmodified text."""
        ids: list[int] = self._tokenizer.encode(text, add_special_tokens=False).ids
        return ids

    @property
    def last_id(self) -> int:
        """Largest id of the tokenizer's own vocabulary; action tokens are counted down from it."""
        return int(self._tokenizer.get_vocab_size(with_added_tokens=False)) - 1

    def encode(self, instruction: str, state: Values) -> list[int]:
        """Token ids of an instruction.

        Args:
            instruction: the task as text.
            state: (n,) normalised, not padded; pi0's prompt does not contain it.

        Raises:
            UngroundedError: the instruction is empty or longer than the model's limit; it is never
                truncated silently.
            CheckpointError: the tokenizer yields an id outside the model's vocabulary.
        """
        # Source: openpi's tokenizer replaces underscores and newlines, LeRobot's pipeline of pi0
        # does not; a newline inside the text would end the prompt early, so it becomes a space.
        text = instruction.strip().replace("\n", " ")
        if self._family == "openpi" or self._variant != "pi0":
            text = text.replace("_", " ")
        if not text:
            raise UngroundedError("The instruction is empty; name the task.")
        end = [self._newline]
        if self._variant != "pi0":
            numbers = " ".join(map(str, state_bins(state)))
            text, end = f"Task: {text}, State: {numbers};\n", [self._bos]
        if self._variant == "pi05":
            text, end = f"{text}{ANSWER}", []
        with reading(Path(self._source), "a tokenizer"):
            ids = [self._bos, *self.token_ids(text), *end]
        if len(ids) > self._max_tokens:
            raise UngroundedError(
                f"The instruction takes {len(ids)} tokens, the model at most {self._max_tokens}; "
                "shorten it."
            )
        if max(ids) >= self._vocabulary:
            raise CheckpointError(
                f"{self._source} yields the id {max(ids)}, the model's vocabulary ends at "
                f"{self._vocabulary - 1}.",
                hint=_WHERE,
            )
        return ids


def load_prompt(
    directory: Path,
    path: Path | None,
    *,
    family: Family,
    max_tokens: int,
    vocabulary: int,
    variant: Variant = "pi0",
) -> InstructionEncoder:
    """Load the tokenizer from `path` (a tokenizer.json or its directory), else from the
    checkpoint's directory.

    Raises:
        CheckpointError: it is missing or cannot be read.
    """
    from tokenizers import Tokenizer  # heavy

    file = path or directory
    file = file / TOKENIZER_FILE if file.is_dir() else file
    if not file.exists():
        raise CheckpointError(f"There is no tokenizer at {file}.", hint=_WHERE)
    if file.suffix != ".json":
        raise CheckpointError(
            f"{file} is not a {TOKENIZER_FILE}; SentencePiece models are not read.", hint=_WHERE
        )
    check_file(file, MAX_TOKENIZER_BYTES)
    with reading(file, "a tokenizer"):
        tokenizer = Tokenizer.from_str(file.read_bytes().decode("utf-8"))
        tokenizer.no_padding()
        tokenizer.no_truncation()
        return InstructionEncoder(
            tokenizer,
            family=family,
            max_tokens=max_tokens,
            vocabulary=vocabulary,
            source=str(file),
            variant=variant,
        )
