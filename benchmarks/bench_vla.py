"""OpenVLA and OpenVLA-OFT with each FastV preset, compared with a plain eager transformers loop and
the device's roofline.

    python benchmarks/bench_vla.py [--device cpu|cuda] [--size small|full] [--repeat 5] [--threads
    1]

Random weights, batch 1, a prompt of 24 tokens, all in one process. On the CPU the models are scaled
down ("small") and computed in `--dtype`, float32 by default; on CUDA they have their real size
("full"), bfloat16, with CUDA graphs. "eager" is transformers' Llama with eager attention, its own
cache and a Python loop, on the same weights, with the same vision front; in float32 its tokens or
actions must be identical. A time is that of one request, from pixels on the host to tokens or
actions on the host, the best of `--repeat`: wall time, or on one CPU thread the processor time,
which other load disturbs less.

The roofline adds up, for vision, prefill and each decode step, the larger of weight bytes /
bandwidth and FLOP / throughput; both are measured in the same number type, as the best of several
runs of a matrix-vector and a square matrix product. The boundary is the backend's part of one
prediction at 224 x 224, without the runtime's.
"""

from __future__ import annotations

import argparse
import functools
import platform
import statistics
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import transformers
from torch import Tensor
from vla_models import PROMPT_TOKENS, make_request, policies, random_weights
from vla_roofline import PRUNED_AFTER, Speed, measure_speed, now_s, roofline_ms

from rn_accel_fastv.config import FastVConfig
from rn_accel_fastv.preset import FastV
from rn_backend_openvla.backend import OpenVlaBackend
from rn_backend_openvla.config import OpenVlaConfig
from rn_backend_openvla.plugin import roboneuron_backends
from rn_runtime_torch.config import TorchRuntimeConfig
from rn_runtime_torch.device import release_memory
from rn_runtime_torch.engine import Engine
from rn_runtime_torch.runtime import TorchRuntime
from rn_testing.fakes import make_observation
from rn_vla.decoding import PolicyModel, Request, RowsReply, RowsRequest
from rn_vla.openvla.layout import VisionShape
from rn_vla.openvla.tiny import make_tiny
from roboneuron.contract import Frame

PRESETS = {"none": 0.0, "fastv-p25": 0.25, "fastv-p50": 0.5, "fastv-p75": 0.75}
PLAIN_TOLERANCE = 1e-3


def best_ms(action: Callable[[Request], object], request: Request, repeat: int) -> float:
    """Best time of `action` after a warm-up run."""
    times = []
    for _ in range(repeat + 1):
        started = now_s()
        action(request)
        times.append((now_s() - started) * 1e3)
    return min(times[1:])


class EagerLoop:
    """transformers' Llama with eager attention on an engine's weights, after the engine's front."""

    def __init__(self, engine: Engine, model: PolicyModel) -> None:
        self.engine, self.shape = engine, model.decoder
        config = transformers.LlamaConfig(
            hidden_size=self.shape.hidden,
            intermediate_size=self.shape.intermediate,
            num_hidden_layers=self.shape.layers,
            num_attention_heads=self.shape.heads,
            num_key_value_heads=self.shape.key_value_heads,
            vocab_size=self.shape.vocabulary,
            rms_norm_eps=self.shape.norm_epsilon,
            max_position_embeddings=self.shape.max_positions,
            attn_implementation="eager",  # type: ignore[call-arg]
        )
        with torch.device("meta"):
            self.llama = transformers.LlamaForCausalLM(config)
        with torch.inference_mode():  # shares the engine's memory, without a second copy
            self.llama.load_state_dict(engine._decoder.slots(), assign=True)
        rotary = self.llama.model.rotary_emb
        self.llama.model.rotary_emb = type(rotary)(config=config).to(engine._device)

    def run(self, request: Request) -> Tensor:
        """Tokens, or the output of the back for the rows."""
        engine = self.engine
        with torch.inference_mode():
            held = {
                name: torch.from_numpy(array)[None].to(engine._device, engine._dtype)
                for name, array in request.prompt.arrays.items()
            }
            ids = torch.from_numpy(request.prompt.ids)[None].to(engine._device)
            hidden = engine._front(held, ids, self.llama.model.embed_tokens)
            if isinstance(request, RowsRequest):
                mask = torch.zeros(
                    1, 1, hidden.shape[1], hidden.shape[1], dtype=hidden.dtype, device=hidden.device
                )
                rows = self.llama.model(
                    inputs_embeds=hidden, attention_mask=mask, use_cache=False
                ).last_hidden_state
                end = rows.shape[1] - request.tail
                assert engine._back is not None
                result: Tensor = engine._back(rows[:, end - request.rows : end])[0]
                return result.float().cpu()
            out = self.llama(inputs_embeds=hidden, use_cache=True, logits_to_keep=1)
            tokens = [out.logits[:, -1].argmax(-1)]
            while len(tokens) < request.max_new_tokens:
                out = self.llama(
                    input_ids=tokens[-1][None], past_key_values=out.past_key_values, use_cache=True
                )
                tokens.append(out.logits[:, -1].argmax(-1))
            return torch.cat(tokens).cpu()


def check_same(ours: Tensor, eager: Tensor, dtype: torch.dtype, name: str) -> None:
    """In float32 both must be identical; in half precision the difference is only reported."""
    if dtype is torch.float32:
        difference = (ours.float() - eager.float()).abs().max().item()
        assert difference < PLAIN_TOLERANCE, (
            f"{name}: our result differs from the eager loop by {difference}"
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class Bench:
    """Settings of the measurement, and destination of the rows."""

    config: TorchRuntimeConfig
    speed: Speed
    repeat: int

    def run(self, name: str, vision: VisionShape, model: PolicyModel) -> None:
        """Print the rows of one backend."""
        request = make_request(model)
        eager_ms = plain_ms = 0.0
        for preset, share in PRESETS.items():
            with random_weights():
                engine = Engine(
                    model,
                    self.config,
                    FastV(FastVConfig(k=PRUNED_AFTER, r=share)) if share else None,
                )
            bound = roofline_ms(model, vision, request, share, self.speed, engine._dtype.itemsize)
            if not share:
                eager = EagerLoop(engine, model)
                if self.config.decode_weights == "same":
                    check_same(answer(engine, request)[0], eager.run(request), engine._dtype, name)
                eager_ms = best_ms(eager.run, request, self.repeat)
                row(name, "eager loop", model.visual_tokens, eager_ms, f"{1:.2f}", "", bound)
                del eager
            took = best_ms(functools.partial(answer, engine), request, self.repeat)
            plain_ms = plain_ms or took
            kept = answer(engine, request)[1]
            row(name, preset, kept, took, f"{eager_ms / took:.2f}", f"{plain_ms / took:.2f}", bound)
            del engine  # before the next is built: two of the real size do not fit on many devices
            release_memory()


def answer(engine: Engine, request: Request) -> tuple[Tensor, int]:
    """The engine's tokens or actions, and the number of kept visual tokens."""
    reply = engine.answer(request, lambda: None)
    values = reply.values if isinstance(reply, RowsReply) else reply.tokens
    return torch.tensor(values), round(reply.metrics["tokens_kept"])


def row(
    name: str,
    preset: str,
    kept: int,
    took_ms: float,
    over_eager: str,
    over_plain: str,
    bound_ms: float,
) -> None:
    """Print one row of the table."""
    print(
        f"| {name} | {preset} | {kept} | {took_ms:.1f} | {over_eager} | {over_plain} "
        f"| {bound_ms:.1f} | {took_ms / bound_ms:.2f} |",
        flush=True,
    )


def measure_boundary(repeat: int) -> float:
    """Median time of one prediction outside the runtime [ms], at 224 x 224."""
    spec = roboneuron_backends()[0]
    with tempfile.TemporaryDirectory() as folder:
        make_tiny(Path(folder))
        config = OpenVlaConfig(checkpoint=Path(folder), profile="libero")
        backend = OpenVlaBackend(
            config, runtime=TorchRuntime(TorchRuntimeConfig(device="cpu", dtype="float32"))
        )
        backend.load()
        image = np.random.default_rng(0).integers(0, 256, (224, 224, 3)).astype(np.uint8)
        frame = Frame(camera="front", image=image, stamp_ns=1, frame_id="front_optical")
        observation = replace(make_observation(spec), frames={"primary": frame})
        costs = []
        for _ in range(repeat + 2):
            metrics = backend.predict(observation).metrics
            costs.append(metrics["inference_ms"] - metrics["model_ms"])
    return statistics.median(costs[2:])


def main() -> None:
    """Measure and print one Markdown table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument(
        "--size", choices=("small", "full"), help="default: small on the CPU, full on CUDA"
    )
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument(
        "--dtype",
        choices=("float32", "bfloat16"),
        help="default: float32 on the CPU, bfloat16 on CUDA",
    )
    parser.add_argument("--decode-weights", choices=("same", "int8"), default="same")
    parser.add_argument("--threads", type=int, default=1, help="CPU threads of torch")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    size = options.size or ("full" if options.device == "cuda" else "small")
    device = torch.device(options.device)
    named: Literal["float32", "bfloat16"] = options.dtype or (
        "bfloat16" if options.device == "cuda" else "float32"
    )
    dtype = getattr(torch, named)
    config = TorchRuntimeConfig(
        device=options.device,
        dtype=named,
        decode_weights=options.decode_weights,
        warm_prompt_tokens=(PROMPT_TOKENS, PROMPT_TOKENS),
    )
    speed = measure_speed(device, dtype)
    what = torch.cuda.get_device_name() if options.device == "cuda" else f"{platform.machine()} CPU"
    print(
        f"{what}, {options.threads} CPU threads, size {size}, {named}, decode weights "
        f"{options.decode_weights}, "
        f"torch {torch.__version__}, transformers {transformers.__version__}, Python "
        f"{platform.python_version()}; "
        f"measured {speed.bandwidth / 1e9:.1f} GB/s and {speed.throughput / 1e12:.3f} TFLOP/s; "
        f"best of {options.repeat}\n"
    )
    print(
        "| backend | preset | visual tokens | ms | x eager | x unpruned | roofline ms | ms / "
        "roofline |"
    )
    print("|---|---|---|---|---|---|---|---|")
    bench = Bench(config=config, speed=speed, repeat=options.repeat)
    with tempfile.TemporaryDirectory() as folder:
        for name, checkpoint, model in policies(size, Path(folder)):
            bench.run(name, checkpoint.vision, model)
    print(
        "\nBoundary, image in to action out without the model, 224 x 224: "
        f"{measure_boundary(50):.2f} ms"
    )


if __name__ == "__main__":
    main()
