"""The runtime's contract case: it launches the stand-in as its server and runs requests on it."""

from __future__ import annotations

import atexit
import functools
import sys
import tempfile
from pathlib import Path

import numpy as np

from rn_runtime_sglang.plugin import roboneuron_runtimes
from rn_testing import RuntimeCase
from rn_vla.decoding import DecoderShape, DecodingPrompt, PolicyModel, TokenRequest


def sglang_case() -> RuntimeCase:
    """The runtime `sglang` in managed mode, with the stand-in instead of SGLang."""
    from rn_runtime_sglang.standin.site import write_site
    from rn_vla.testing import check_token_answer, late

    @functools.cache
    def directory() -> Path:
        held = tempfile.TemporaryDirectory(prefix="rn-runtime-sglang-")
        atexit.register(held.cleanup)
        write_checkpoint(Path(held.name) / "checkpoint")
        write_site(Path(held.name) / "site")
        return Path(held.name)

    return RuntimeCase(
        spec=roboneuron_runtimes()[0],
        options={
            "python": sys.executable,
            "environment": {"PYTHONPATH": str(directory() / "site")},
            "poll_s": 0.1,
            "start_timeout_s": 30.0,
        },
        model=lambda: policy_model(directory() / "checkpoint"),
        request=token_request,
        bad_request=lambda: token_request(count=65),
        late_request=lambda: late(token_request()),
        check_answer=check_token_answer,
    )


def write_checkpoint(path: Path, content: str = "weights") -> Path:
    """Write files with a fingerprint, from which no model can be loaded."""
    path.mkdir(parents=True)
    (path / "config.json").write_text('{"model_type": "openvla"}', encoding="utf-8")
    (path / "model.safetensors").write_text(content, encoding="utf-8")
    return path


def policy_model(checkpoint: Path) -> PolicyModel:
    """A model with the parts that a served runtime uses."""

    def build_front() -> object:
        raise AssertionError("a served runtime builds no module")

    return PolicyModel(
        family="openvla",
        checkpoint=checkpoint,
        decoder=DecoderShape(
            hidden=16,
            intermediate=32,
            layers=3,
            heads=2,
            key_value_heads=2,
            vocabulary=32064,
            norm_epsilon=1e-6,
            rope_theta=10000.0,
            max_positions=2048,
        ),
        shards=(),
        visual_tokens=256,
        max_prompt_tokens=64,
        max_new_tokens=7,
        example=lambda count: token_request(count=count),
        build_front=build_front,
    )


def token_request(count: int = 9, seed: int = 0, deadline_s: float | None = None) -> TokenRequest:
    """A request with a small random image and `count` prompt ids."""
    generator = np.random.default_rng(seed)
    ids = np.array([1, *generator.integers(3, 29000, count - 2), 29871], dtype=np.int64)
    image = generator.integers(0, 256, (32, 48, 3), dtype=np.uint8)
    prompt = DecodingPrompt(text="In: What action ...", ids=ids, images=(image,), arrays={})
    return TokenRequest(prompt=prompt, max_new_tokens=7, deadline_s=deadline_s)
