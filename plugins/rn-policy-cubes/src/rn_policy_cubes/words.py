"""The tokenizer of the policy, the sentences of its training, and their token ids."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rn_policy_cubes.demonstrations import COLOURS
from rn_policy_cubes.network import STOP_ID
from rn_policy_cubes.recipe import PADDING, VOCABULARY
from rn_vla.openvla.prompt import BOS_ID, FINAL_ID, PromptEncoder, save_tokenizer

I64 = NDArray[np.int64]

SENTENCES = (
    "pick up the {} cube",
    "please take the {} cube",
    "fetch the small {} block",
    "pick up the {} block",
    "please grab the {} box",
    "pick the {} cube up",
    "now lift the {} block",
    "get me the {} cube",
)
"""Sentences of equal length, so that compiled layers have one shape."""
_PREFIX, _SUFFIX = "▁In:▁What▁action▁should▁the▁robot▁take▁to", "?\nOut:"
COMMON_WORDS = (
    "a all and at block box brick button collect cube cubes down fetch from get grab grasp hand "
    "hold in it lift "
    "little me move now of on one pick piece place please put raise robot seize small square "
    "table take that the "
    "this thing to up "
    "want wooden you red green blue yellow orange purple"
)


def write_tokenizer(path: Path) -> None:
    """Write tokenizer.json: the special ids of Llama, one id for each common word and for both ends
    of the prompt.

    Other words are encoded as letters and bytes, as usual.
    """
    vocabulary = {"<unk>": 0, "<s>": BOS_ID, "</s>": STOP_ID}
    vocabulary |= {f"<0x{byte:02X}>": 3 + byte for byte in range(256)}
    pieces = ["\n", *(chr(code) for code in range(33, 127))]
    merges: list[tuple[str, str]] = []
    for chain in (_PREFIX, _SUFFIX, *(f"▁{word}" for word in COMMON_WORDS.split())):
        built = chain[0]
        for letter in chain[1:]:
            merges.append((built, letter))
            built += letter
            pieces.append(built)
    for piece in dict.fromkeys(pieces):
        vocabulary[piece] = len(vocabulary)
    base = VOCABULARY - PADDING
    vocabulary |= {
        f"<unused_{index}>": index for index in range(len(vocabulary), base) if index != FINAL_ID
    }
    vocabulary["▁"] = FINAL_ID
    save_tokenizer(path, vocabulary, merges)


@dataclass(frozen=True, slots=True)
class Prompts:
    """Token ids of all sentences.

    Attributes:
        by_length: int64 (sentences, colours, length), one array for each length.
        in_use: every id that has an embedding, ascending.
    """

    by_length: tuple[I64, ...]
    in_use: tuple[int, ...]

    @property
    def share(self) -> NDArray[np.float64]:
        """Fraction of the sentences with each length."""
        counts = np.array([len(ids) for ids in self.by_length], dtype=np.float64)
        return np.asarray(counts / counts.sum())


def read_prompts(tokenizer: Path, sentences: Sequence[str] = SENTENCES) -> Prompts:
    """Encode the sentences as in rn-backend-oft."""
    encoder = PromptEncoder(tokenizer, "v02", base=VOCABULARY - PADDING, embeddings=VOCABULARY)
    found: dict[int, list[I64]] = {}
    for sentence in sentences:
        ids = [encoder.to_ids(encoder.to_text(sentence.format(colour))) for colour in COLOURS]
        found.setdefault(len(ids[0]), []).append(np.stack(ids))
    known = {BOS_ID, STOP_ID, FINAL_ID, *range(3, _first_unused(tokenizer))}
    return Prompts(tuple(np.stack(found[length]) for length in sorted(found)), tuple(sorted(known)))


def _first_unused(tokenizer: Path) -> int:
    from tokenizers import Tokenizer

    vocabulary = Tokenizer.from_file(str(tokenizer)).get_vocab()
    return min(index for piece, index in vocabulary.items() if piece.startswith("<unused_"))
