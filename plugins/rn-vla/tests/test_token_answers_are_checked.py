"""Contract checks of token answers; each kind of wrong answer is distinguished."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rn_testing.rule import Violation
from rn_vla.decoding import (
    DecoderShape,
    DecodingPrompt,
    PolicyModel,
    RowsReply,
    TokenReply,
    TokenRequest,
)
from rn_vla.testing import check_token_answer, late

VOCABULARY = 32
REQUEST = TokenRequest(
    prompt=DecodingPrompt(text="go", ids=np.array([1, 2, 3]), images=(), arrays={}),
    max_new_tokens=4,
    with_logits=True,
)
MODEL = PolicyModel(
    family="openvla",
    checkpoint=Path("tiny"),
    decoder=DecoderShape(
        hidden=8,
        intermediate=8,
        layers=1,
        heads=1,
        key_value_heads=1,
        vocabulary=VOCABULARY,
        norm_epsilon=1e-6,
        rope_theta=1e4,
        max_positions=64,
    ),
    shards=(),
    visual_tokens=0,
    max_prompt_tokens=8,
    max_new_tokens=8,
    example=lambda count: REQUEST,
    build_front=lambda: None,
)
TOKENS = np.arange(4) + 6
LOGITS = np.eye(VOCABULARY, dtype=np.float32)[6]


def test_an_answer_as_it_should_be_passes():
    check_token_answer(MODEL, REQUEST, TokenReply(tokens=TOKENS, logits=LOGITS))
    check_token_answer(MODEL, REQUEST, TokenReply(tokens=TOKENS))
    check_token_answer(
        MODEL, replace(REQUEST, with_logits=False), TokenReply(tokens=TOKENS, logits=LOGITS[:3])
    )


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (TokenReply(tokens=TOKENS[:-1]), "asked for 4"),
        (TokenReply(tokens=np.append(TOKENS, 1)), "asked for 4"),
        (TokenReply(tokens=TOKENS[None]), "asked for 4"),
        (TokenReply(tokens=TOKENS + VOCABULARY), "vocabulary"),
        (TokenReply(tokens=-TOKENS), "vocabulary"),
        (TokenReply(tokens=TOKENS, logits=LOGITS[:-1]), "shape"),
        (TokenReply(tokens=TOKENS, logits=LOGITS * np.nan), "finite"),
        (TokenReply(tokens=TOKENS, logits=np.roll(LOGITS, 1)), "best"),
        (RowsReply(values=np.zeros(4, dtype=np.float32)), "RowsReply"),
        (TOKENS.tolist(), "list"),
    ],
)
def test_a_wrong_answer_is_named(answer, words):
    with pytest.raises(Violation, match=words):
        check_token_answer(MODEL, REQUEST, answer)


def test_a_late_request_differs_in_its_deadline_only():
    request = late(REQUEST)
    assert request.deadline_s < time.monotonic()
    assert (request.prompt, request.max_new_tokens) == (REQUEST.prompt, REQUEST.max_new_tokens)
