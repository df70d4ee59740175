"""A small action tokenizer in the published layout, for tiny checkpoints of pi0-FAST."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from tokenizers import Tokenizer, decoders, models, pre_tokenizers, trainers

from rn_backend_pi0.fast_tokens import FAST_DIRECTORY, cosines

TINY_SKIP_TOKENS = 4
_SCALE, _LEAST, _GREATEST = 10.0, -48, 48
_VOCABULARY = 128
_CHUNKS = 200


def write_fast_tokenizer(checkpoint: Path, *, horizon: int, width: int) -> None:
    """Write processor_config.json and tokenizer.json, trained on random smooth chunks, to the
    tokenizer folder of the checkpoint. Every token consists of whole coefficients.
    """
    directory = checkpoint / FAST_DIRECTORY
    directory.mkdir()
    tokenizer = Tokenizer(models.BPE())
    byte_level = pre_tokenizers.ByteLevel(add_prefix_space=False)
    tokenizer.pre_tokenizer, tokenizer.decoder = byte_level, decoders.ByteLevel()
    letters = [chr(code) for code in range(_GREATEST - _LEAST + 1)]
    alphabet = ["".join(piece for piece, _ in byte_level.pre_tokenize_str(c)) for c in letters]
    trainer = trainers.BpeTrainer(
        vocab_size=_VOCABULARY, initial_alphabet=alphabet, special_tokens=[], show_progress=False
    )
    tokenizer.train_from_iterator(_texts(horizon, width), trainer)
    tokenizer.save(str(directory / "tokenizer.json"))
    config = {
        "processor_class": "UniversalActionProcessor",
        "scale": _SCALE,
        "vocab_size": _VOCABULARY,
        "min_token": _LEAST,
        "time_horizon": horizon,
        "action_dim": width,
    }
    (directory / "processor_config.json").write_text(json.dumps(config, indent=2) + "\n")


def _texts(horizon: int, width: int) -> list[str]:
    random = np.random.default_rng(3)
    matrix = cosines(horizon)
    texts = []
    for _ in range(_CHUNKS):
        steps = random.normal(0.0, 0.2, (horizon, width)).cumsum(axis=0)
        rounded = np.around(matrix @ steps.clip(-1.0, 1.0) * _SCALE).clip(_LEAST, _GREATEST)
        texts.append("".join(chr(int(value) - _LEAST) for value in rounded.flatten()))
    return texts
