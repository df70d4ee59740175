"""Replies of the stand-in: shapes and texts as recorded from SGLang 0.5.23 with this package's
model.
"""

from __future__ import annotations

import base64
import hashlib
import json
from dataclasses import dataclass
from typing import Literal

ACTION_TOKENS = range(31744, 32000)
BOS_ID, FINAL_ID = 1, 29871
Fault = Literal[
    "",
    "malformed",
    "short",
    "range",
    "other",
    "nan",
    "error",
    "hang",
    "trickle",
    "hang up",
    "too long",
]


@dataclass
class Behaviour:
    """Behaviour of a stand-in; may be changed while it runs.

    Attributes:
        served_name, model_path, architecture, version: its identity.
        key: API key; empty for none.
        ready: answer of `/ready`.
        delay_s: delay of each reply of `/generate` [s].
        fault: fault of the replies of `/generate`.
        running, queued: load that `/metrics` reports; None for a server without metrics.
    """

    served_name: str
    model_path: str
    architecture: str = "OpenVLAForActionPrediction"
    version: str = "0.5.23"
    key: str = ""
    ready: bool = True
    delay_s: float = 0.0
    fault: Fault = ""
    running: float | None = 0.0
    queued: float = 0.0


def expected_tokens(ids: list[int], image: bytes, count: int) -> list[int]:
    """Tokens that depend on all inputs of a model."""
    seed = hashlib.sha256(json.dumps(ids).encode() + image).digest()
    return [ACTION_TOKENS[seed[index % len(seed)]] for index in range(count)]


def request_problem(body: dict[str, object]) -> str:
    """Reason why SGLang and the served processor would refuse the request; empty for none."""
    ids, image = body.get("input_ids"), body.get("image_data")
    if not isinstance(ids, list):
        return "The engine initialized with skip_tokenizer_init=True cannot accept text prompts."
    if len(ids) < 2 or ids[0] != BOS_ID or ids[-1] != FINAL_ID:
        return f"the prompt's ids are {ids[:2]} ... {ids[-1:]}, expected [{BOS_ID} ... {FINAL_ID}]"
    if not isinstance(image, str) or not base64.b64decode(image).startswith((b"\x89PNG", b"BM")):
        return "the image is not base64 of a PNG or BMP picture"
    return ""


def generate_reply(
    rid: str, tokens: list[int], finish: dict[str, object], prompt: int, spent_s: float
) -> dict[str, object]:
    """A reply of `/generate`."""
    meta = {
        "id": rid,
        "finish_reason": finish,
        "prompt_tokens": prompt,
        "weight_version": "default",
        "queue_time": 0.001,
        "completion_tokens": len(tokens),
        "cached_tokens": 1,
        "dp_rank": None,
        "e2e_latency": spent_s + 0.002,
        "first_token_latency": spent_s + 0.001,
    }
    return {"output_ids": tokens, "meta_info": meta}


def model_info(told: Behaviour) -> dict[str, object]:
    """A reply of `/model_info`."""
    return {
        "model_path": told.model_path,
        "served_model_name": told.served_name,
        "tokenizer_path": told.model_path,
        "is_generation": True,
        "weight_version": "default",
        "has_image_understanding": False,
        "model_type": "openvla",
        "architectures": [told.architecture],
    }


def server_info(told: Behaviour) -> dict[str, object]:
    """A reply of `/server_info`."""
    return {
        "model_path": told.model_path,
        "skip_tokenizer_init": True,
        "version": told.version,
        "frontend": "python",
    }


def metrics_text(told: Behaviour) -> str:
    """A reply of `/metrics`."""
    labels = f'{{engine_type="unified",model_name="{told.served_name}",tp_rank="0"}}'
    return (
        "# HELP sglang:num_running_reqs The number of running requests.\n# TYPE "
        "sglang:num_running_reqs gauge\n"
        f"sglang:num_running_reqs{labels} {told.running}\n"
        f"sglang:num_queue_reqs{labels} {told.queued}\n"
        f"sglang:token_usage{labels} 0.07\n"
    )
