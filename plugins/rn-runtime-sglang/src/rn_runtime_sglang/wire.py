"""Encoding of requests to SGLang's `/generate`, and checked decoding of its replies."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from rn_vla.decoding import TokenRequest
from roboneuron import (
    ForeignDataError,
    InvalidInputError,
    NotReadyError,
    UnsafeError,
    foreign,
)

I64 = NDArray[np.int64]
_MOST_BYTES = 1 << 24
UNUSABLE_TOKEN = 0
"""Token that the served model decodes for non-finite logits."""
_TIMES = {
    "e2e_latency": "served.model_ms",
    "first_token_latency": "served.first_token_ms",
    "queue_time": "served.queue_ms",
}
_COUNTS = {"prompt_tokens": "served.prompt_tokens", "cached_tokens": "served.cached_tokens"}


class MalformedReply(NotReadyError):
    """A server's reply violates the protocol; another server may answer correctly."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Generated:
    """A valid reply: int64 tokens and metrics."""

    tokens: I64
    metrics: Mapping[str, float]


def encode_body(request: TokenRequest, image_format: str) -> bytes:
    """Encode a request without its id: JSON without the opening brace, see `with_id`.

    Raises:
        InvalidInputError: not exactly one image, no prompt, or logits are requested.
    """
    prompt = request.prompt
    if request.with_logits:
        raise InvalidInputError(
            "Logits are not available from a served model.", hint="Use the runtime torch."
        )
    if len(prompt.images) != 1:
        raise InvalidInputError(
            f"A served request takes exactly one image, got {len(prompt.images)}."
        )
    if prompt.ids.size < 2 or request.max_new_tokens < 1:
        raise InvalidInputError(
            f"The request has {prompt.ids.size} prompt ids and asks for {request.max_new_tokens} "
            "tokens."
        )
    buffer = io.BytesIO()
    options: dict[str, object] = {"compress_level": 1} if image_format == "png" else {}
    Image.fromarray(prompt.images[0]).save(buffer, format=image_format, **options)
    body = {
        "input_ids": prompt.ids.tolist(),
        "image_data": base64.b64encode(buffer.getbuffer()).decode("ascii"),
        "sampling_params": {
            "temperature": 0,
            "max_new_tokens": request.max_new_tokens,
            "ignore_eos": True,
        },
    }
    return json.dumps(body, separators=(",", ":")).encode()[1:]


def with_id(rid: str, body: bytes) -> bytes:
    """The complete JSON of one attempt; each has its own id, so that it can be aborted
    separately.
    """
    return b'{"rid":"' + rid.encode("ascii") + b'",' + body


def parse_object(raw: bytes, where: str) -> dict[str, object]:
    """The JSON object in `raw`. Raises MalformedReply."""
    try:
        value = foreign.decode_json(raw, where, most_bytes=_MOST_BYTES)
    except ForeignDataError as error:
        raise MalformedReply(f"{error}; it begins with {_short(raw)}.") from error
    if not isinstance(value, dict):
        raise MalformedReply(f"{where} is a {type(value).__name__}, expected an object.")
    return value


def error_text(raw: bytes) -> str:
    """The server's error message, in any of its three forms."""
    try:
        value = foreign.decode_json(raw, "an error")
    except ForeignDataError:
        return _short(raw)
    if isinstance(value, dict):
        error = value.get("error", value.get("message", value))
        return str(error.get("message", error) if isinstance(error, dict) else error)[:300]
    return _short(raw)


def parse_reply(raw: bytes, where: str, *, rid: str, count: int, vocabulary: int) -> Generated:
    """Check a reply of `/generate`.

    Raises:
        MalformedReply: a field is missing or of the wrong type, number or range; or it answers
            another request.
        NotReadyError: the server aborted the request.
        UnsafeError: the model's logits were not finite.
    """
    reply = parse_object(raw, f"The reply of {where}")
    meta = reply.get("meta_info")
    if not isinstance(meta, dict) or meta.get("id") != rid:
        got = meta.get("id") if isinstance(meta, dict) else meta
        raise MalformedReply(f"The reply of {where} answers the request {got!r}, expected {rid!r}.")
    finish = meta.get("finish_reason")
    reason = finish.get("type") if isinstance(finish, dict) else None
    if reason == "abort":
        raise NotReadyError(f"{where} aborted the request.")
    if reason != "length":
        raise MalformedReply(f"The reply of {where} ended by {finish!r}, expected 'length'.")
    tokens = reply.get("output_ids")
    if (
        not isinstance(tokens, list)
        or len(tokens) != count
        or not all(type(token) is int and 0 <= token < vocabulary for token in tokens)
    ):
        raise MalformedReply(
            f"The reply of {where} holds output_ids {_short(tokens)}, expected {count} ids below "
            f"{vocabulary}."
        )
    if UNUSABLE_TOKEN in tokens:
        raise UnsafeError(
            f"The model served by {where} produced NaN or infinite values; no action was made of "
            "them."
        )
    metrics = {
        name: float(meta[key]) * 1e3 for key, name in _TIMES.items() if _is_number(meta.get(key))
    }
    metrics |= {
        name: float(meta[key]) for key, name in _COUNTS.items() if _is_number(meta.get(key))
    }
    return Generated(tokens=np.array(tokens, dtype=np.int64), metrics=metrics)


def parse_metrics(text: str, names: Mapping[str, str]) -> dict[str, float]:
    """Sums over all labels of the wanted metrics in Prometheus' text format; unreadable lines are
    skipped.

    Args:
        text: body of `/metrics`.
        names: name in RoboNeuron by SGLang's name.
    """
    found: dict[str, float] = {}
    for line in text.splitlines():
        name = line.partition("{")[0].partition(" ")[0]
        if name in names:
            try:
                value = float(line.rpartition("}")[2].split()[-1])
            except (ValueError, IndexError):
                continue
            found[names[name]] = found.get(names[name], 0.0) + value
    return found


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 80 else text[:77] + "..."
