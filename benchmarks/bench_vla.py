"""OpenVLA and OpenVLA-OFT, each FastV preset, beside a plain eager transformers loop and the
device's roofline.

    python benchmarks/bench_vla.py [--device cpu|cuda] [--size small|full] [--repeat 5] [--threads
    1]

Random weights, batch 1, a prompt of 24 tokens, all in one process. On the CPU the models are scaled
down ("small") and computed in `--dtype`, float32 by default; on CUDA they have their real size
("full"), bfloat16, with CUDA graphs. "eager" is transformers' Llama with eager attention, its own
cache and a Python loop, on the same weights, behind the same vision front; in float32 its tokens or
actions must equal ours. A time is that of one request, pixels on the host to tokens or actions on
the host, the best of `--repeat`: wall time, or on one CPU thread the processor time, which others
on a shared machine disturb less.

The roofline adds up, for vision, prefill and each decode step, the larger of weight bytes /
bandwidth and FLOP / throughput; both are measured here, in the same number type, as the best of
several runs of a matrix-vector and a square matrix product. The boundary is the backend's share of
one prediction at 224 x 224: all but the runtime's.
"""

from __future__ import annotations

import argparse
import functools
import platform
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal
from unittest.mock import patch

import numpy as np
import torch
import transformers
from torch import Tensor

from rn_accel_fastv.config import FastVConfig
from rn_accel_fastv.preset import FastV
from rn_backend_oft.constants import CONSTANTS
from rn_backend_oft.policy import OftPolicy
from rn_backend_openvla.backend import OpenVlaBackend
from rn_backend_openvla.config import OpenVlaConfig
from rn_backend_openvla.plugin import roboneuron_backends
from rn_runtime_torch.config import TorchRuntimeConfig
from rn_runtime_torch.device import release_memory
from rn_runtime_torch.engine import Engine
from rn_runtime_torch.runtime import TorchRuntime
from rn_testing.fakes import make_observation
from rn_vla.decoding import DecoderShape, PolicyModel, Request, RowsReply, RowsRequest
from rn_vla.openvla.checkpoint import BACKBONES, OpenvlaCheckpoint
from rn_vla.openvla.layout import TowerShape, VisionShape
from rn_vla.openvla.policy import policy_model
from rn_vla.openvla.preprocessing import TowerPixels
from rn_vla.openvla.tiny import make_tiny
from roboneuron.contract import Frame

PROMPT_TOKENS = 24
PRESETS = {"none": 0.0, "fastv-p25": 0.25, "fastv-p50": 0.5, "fastv-p75": 0.75}
PRUNED_AFTER = 2
PLAIN_TOLERANCE = 1e-3

FULL = DecoderShape(
    hidden=4096,
    intermediate=11008,
    layers=32,
    heads=32,
    key_value_heads=32,
    vocabulary=32064,
    norm_epsilon=1e-6,
    rope_theta=10000.0,
    max_positions=2048,
)
SMALL = replace(FULL, hidden=384, intermediate=1032, layers=8, heads=6, key_value_heads=6)


@dataclass(frozen=True, kw_only=True, slots=True)
class Speed:
    """What the device was seen to do: bytes and FLOP per second."""

    bandwidth: float
    throughput: float

    def bound_s(
        self, parameters: float, tokens: float, attention_flop: float, itemsize: int
    ) -> float:
        """Shortest time for `tokens` rows through `parameters` weights."""
        flop = 2 * parameters * tokens + attention_flop
        return max(parameters * itemsize / self.bandwidth, flop / self.throughput)


def shrink(tower: TowerShape) -> TowerShape:
    """A tower of an eighth of the width and a quarter of the depth."""
    return replace(
        tower,
        width=tower.width // 8,
        depth=tower.depth // 4,
        heads=4,
        intermediate=tower.intermediate // 8,
    )


def make_checkpoint(size: str, path: Path) -> OpenvlaCheckpoint:
    """Shapes alone; the weights are made on the device."""
    towers = BACKBONES["dinosiglip-vit-so-224px"]
    decoder = FULL if size == "full" else SMALL
    return OpenvlaCheckpoint(
        path=path,
        decoder=decoder,
        vision=VisionShape(
            towers=towers if size == "full" else tuple(map(shrink, towers)), hidden=decoder.hidden
        ),
        action_bins=256,
        token_vocabulary=32000,
        is_vicuna=False,
        towers=(TowerPixels(mean=(0.5,) * 3, std=(0.5,) * 3),) * 2,
        statistics={},
        statistics_source="",
        shards=(),
    )


@contextmanager
def random_weights(seed: int = 0) -> Iterator[None]:
    """Engines built inside fill their parameters at random instead of reading files."""

    def fill(shards: object, slots: dict[str, Tensor]) -> None:
        for index, slot in enumerate(slots.values()):
            torch.manual_seed(seed + index)
            slot.normal_(std=slot.shape[-1] ** -0.5) if slot.ndim > 1 else slot.fill_(1.0)

    with (
        patch("rn_runtime_torch.engine.load_shards", fill),
        patch("rn_runtime_torch.engine.check_shards"),
    ):
        yield


def now_s() -> float:
    """Processor time when one CPU thread computes, else wall time."""
    return (
        time.perf_counter()
        if torch.cuda.is_available() or torch.get_num_threads() > 1
        else time.process_time()
    )


def best_ms(action: Callable[[Request], object], request: Request, repeat: int) -> float:
    """Best time of `action` after a run that does not count."""
    times = []
    for _ in range(repeat + 1):
        started = now_s()
        action(request)
        times.append((now_s() - started) * 1e3)
    return min(times[1:])


def measure_speed(device: torch.device, dtype: torch.dtype) -> Speed:
    """Best of ten: a matrix-vector product of 256 MB or more, a square product."""
    side, square = (16384, 8192) if device.type == "cuda" else (8192, 1536)
    wide, vector = (
        torch.randn(side, side, device=device).to(dtype),
        torch.ones(side, device=device, dtype=dtype),
    )
    matrix = torch.randn(square, square, device=device).to(dtype)

    def best(action: Callable[[], object]) -> float:
        times = []
        for _ in range(10):
            synchronize(device)
            started = now_s()
            action()
            synchronize(device)
            times.append(now_s() - started)
        return min(times)

    return Speed(
        bandwidth=wide.nbytes / best(lambda: wide @ vector),
        throughput=2 * square**3 / best(lambda: matrix @ matrix),
    )


def synchronize(device: torch.device) -> None:
    """Wait for the device."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def roofline_ms(
    model: PolicyModel, vision: VisionShape, request: Request, share: float, speed: Speed, item: int
) -> float:
    """Bound for one request; see the module."""
    decoder = model.decoder
    images = model.visual_tokens // vision.towers[0].patches
    total = 0.0
    for tower in vision.towers:
        layers, width, tokens = tower.depth - 1, tower.width, tower.patches + tower.prefix_tokens
        parameters = layers * (4 * width**2 + 2 * width * tower.intermediate)
        total += speed.bound_s(
            parameters, images * tokens, images * layers * 4 * tokens**2 * width, item
        )
    pairs = zip(vision.projector, vision.projector[1:], strict=False)
    total += speed.bound_s(sum(a * b for a, b in pairs), model.visual_tokens, 0, item)
    length = model.visual_tokens + model.extra_tokens + request.prompt.ids.size
    kept = length - round(model.visual_tokens * share)
    layer = 4 * decoder.hidden**2 + 3 * decoder.hidden * decoder.intermediate
    split = PRUNED_AFTER if share else decoder.layers
    causal = 1 if isinstance(request, RowsRequest) else 2
    for layers, tokens in ((split, length), (decoder.layers - split, kept)):
        attention = 4 * tokens**2 * decoder.hidden / causal
        total += layers * speed.bound_s(layer, tokens, attention, item)
    if not isinstance(request, RowsRequest):
        head = decoder.vocabulary * decoder.hidden
        steps = request.max_new_tokens
        total += steps * speed.bound_s(head, 1, 0, item)
        total += (steps - 1) * speed.bound_s(decoder.layers * layer, 1, 0, item)
    return total * 1e3


class EagerLoop:
    """transformers' Llama with eager attention on an engine's weights, behind the engine's
    front.
    """

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
        with torch.inference_mode():  # the engine's own memory, no second copy
            self.llama.load_state_dict(engine._decoder.slots(), assign=True)
        rotary = self.llama.model.rotary_emb
        self.llama.model.rotary_emb = type(rotary)(config=config).to(engine._device)

    def run(self, request: Request) -> Tensor:
        """Tokens, or what the back makes of the rows."""
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


def policies(size: str, path: Path) -> Iterator[tuple[str, OpenvlaCheckpoint, PolicyModel]]:
    """The models to measure."""
    checkpoint = make_checkpoint(size, path)
    for component in ("action_head", "proprio_projector"):
        (path / f"{component}--0_checkpoint.pt").touch()
    yield "openvla", checkpoint, policy_model(checkpoint, action_width=7, max_prompt_tokens=64)
    oft = OftPolicy(
        checkpoint=checkpoint, constants=CONSTANTS["libero"], cameras=2, head="l1", proprio_width=8
    )
    yield "oft", checkpoint, oft.model(64)


def make_request(model: PolicyModel) -> Request:
    """A request with random pixels."""
    request = model.example(PROMPT_TOKENS)
    generator = np.random.default_rng(0)
    arrays = {
        name: generator.standard_normal(array.shape).astype(np.float32)
        for name, array in request.prompt.arrays.items()
    }
    return replace(request, prompt=replace(request.prompt, arrays=arrays))


def check_same(ours: Tensor, eager: Tensor, dtype: torch.dtype, name: str) -> None:
    """In float32 both must give the same; half precision is only reported."""
    if dtype is torch.float32:
        difference = (ours.float() - eager.float()).abs().max().item()
        assert difference < PLAIN_TOLERANCE, (
            f"{name}: our result differs from the eager loop by {difference}"
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class Bench:
    """How to measure, and where the rows go."""

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
    """Our tokens or actions, and the visual tokens that were kept."""
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
    """Median milliseconds of one prediction that are not the runtime's, at 224 x 224."""
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
