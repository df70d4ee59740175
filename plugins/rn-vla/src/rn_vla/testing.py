"""Parts of contract cases for runtimes of Llama-shaped decoders."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from rn_testing.rule import Violation, require
from rn_vla.decoding import PolicyModel, Reply, TokenReply, TokenRequest


def late(request: TokenRequest) -> TokenRequest:
    """The same request with a deadline in the past: `RuntimeCase.late_request`."""
    return replace(request, deadline_s=time.monotonic() - 1.0)


def check_token_answer(model: PolicyModel, request: TokenRequest, answer: Reply) -> None:
    """Raise Violation unless the answer holds the requested tokens: `RuntimeCase.check_answer`."""
    if not isinstance(answer, TokenReply):
        raise Violation(
            f"run of a TokenRequest returned {type(answer).__name__}, expected a TokenReply"
        )
    count, vocabulary = request.max_new_tokens, model.decoder.vocabulary
    require(
        answer.tokens.shape == (count,),
        f"a reply holds tokens {answer.tokens.shape}, asked for {count}",
    )
    inside = bool(((answer.tokens >= 0) & (answer.tokens < vocabulary)).all())
    require(inside, f"a reply holds a token outside of the vocabulary of {vocabulary}")
    if request.with_logits and answer.logits is not None:
        require(
            answer.logits.shape == (vocabulary,),
            f"logits have shape {answer.logits.shape}, expected {vocabulary}",
        )
        require(bool(np.isfinite(answer.logits).all()), "logits hold a value that is not finite")
        best = int(np.argmax(answer.logits))
        require(
            best == int(answer.tokens[0]),
            f"the first token is {answer.tokens[0]}, the logits' best is {best}",
        )
