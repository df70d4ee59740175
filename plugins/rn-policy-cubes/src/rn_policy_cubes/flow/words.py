"""The tokenizer of the flow policy and the token ids of its training sentences."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rn_policy_cubes.demonstrations import COLOURS
from rn_policy_cubes.words import COMMON_WORDS, SENTENCES, Prompts

BOS_PIECE, END_PIECE = "<bos>", "\n"


def write_flow_tokenizer(path: Path) -> int:
    """Write tokenizer.json with PaliGemma's special tokens; returns the size of its vocabulary.

    Each common word has one id. Other words are encoded as letters, unknown characters as <unk>.
    """
    from tokenizers import AddedToken, Tokenizer, models, normalizers

    pieces = ["<pad>", "<eos>", BOS_PIECE, "<unk>", "▁", *(chr(code) for code in range(33, 127))]
    merges: list[tuple[str, str]] = []
    for word in COMMON_WORDS.split():
        built = "▁"
        for letter in word:
            merges.append((built, letter))
            built += letter
            pieces.append(built)
    vocabulary = {piece: index for index, piece in enumerate(dict.fromkeys(pieces))}
    tokenizer = Tokenizer(
        models.BPE(
            vocab=vocabulary, merges=list(dict.fromkeys(merges)), unk_token="<unk>", fuse_unk=True
        )
    )
    tokenizer.normalizer = normalizers.Sequence(
        [normalizers.Prepend("▁"), normalizers.Replace(" ", "▁")]
    )
    tokenizer.add_tokens([AddedToken(END_PIECE, normalized=False)])
    tokenizer.save(str(path))
    return int(tokenizer.get_vocab_size(with_added_tokens=True))


def read_flow_prompts(path: Path) -> Prompts:
    """Encode the training sentences as rn-backend-pi0 does: BOS, the text, a newline."""
    from tokenizers import Tokenizer

    tokenizer = Tokenizer.from_file(str(path))
    ends = [tokenizer.token_to_id(piece) for piece in (BOS_PIECE, END_PIECE)]
    found: dict[int, list[NDArray[np.int64]]] = {}
    for sentence in SENTENCES:
        texts = [sentence.format(colour) for colour in COLOURS]
        encoded = [tokenizer.encode(text, add_special_tokens=False).ids for text in texts]
        ids = np.array([[ends[0], *inner, ends[1]] for inner in encoded])
        found.setdefault(ids.shape[1], []).append(ids)
    size = tokenizer.get_vocab_size(with_added_tokens=True)
    by_length = tuple(np.stack(found[length]) for length in sorted(found))
    return Prompts(by_length, tuple(range(size)))
