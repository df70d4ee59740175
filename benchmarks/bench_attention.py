"""Attention over a whole prompt on the CPU, as the runtime "torch" computes it, compared with its
floor in the same run.

    python benchmarks/bench_attention.py [--threads 1] [--repeat 20]

One layer of real width, batch 1: OpenVLA's decoder (280 positions, causal, keys and values in the
cache) and OFT's (600 positions, without a mask). "products" is the floor: the FLOP of both matrix
products at the speed of a square product of the same type; all scores count, including masked ones,
because the kernel computes them. "softmax" is torch's softmax of the scores, which the floor
excludes. "separately" is product, softmax, product in sequence. Times are the best of `--repeat`
interleaved runs: processor time on one thread, which other load disturbs less, otherwise wall time.
"""

from __future__ import annotations

import argparse
import platform
import time
from collections.abc import Callable

import torch
from torch import Tensor

from rn_runtime_torch.cache import KeyValueCache
from rn_runtime_torch.decoder import DecoderLayer
from rn_vla.decoding import DecoderShape

LLAMA = DecoderShape(
    hidden=4096,
    intermediate=11008,
    layers=1,
    heads=32,
    key_value_heads=32,
    vocabulary=32,
    norm_epsilon=1e-6,
    rope_theta=10000.0,
    max_positions=1024,
)
PROMPTS = {"openvla": (280, True), "oft": (600, False)}
"""Number of positions, and whether the mask is causal."""
SQUARE = 1536
TOLERANCE = {torch.float32: 1e-5, torch.bfloat16: 0.05}
"""Values reach 5; bfloat16 keeps 8 bits of a result."""
CPU = torch.device("cpu")


def best_ms(actions: dict[str, Callable[[], object]], repeat: int) -> dict[str, float]:
    """Best time of each action, interleaved, after one warm-up run."""
    now_s = time.process_time if torch.get_num_threads() == 1 else time.perf_counter
    times: dict[str, list[float]] = {name: [] for name in actions}
    for _ in range(repeat + 1):
        for name, action in actions.items():
            begun_s = now_s()
            action()
            times[name].append((now_s() - begun_s) * 1e3)
    return {name: min(values[1:]) for name, values in times.items()}


def measure(name: str, dtype: torch.dtype, repeat: int) -> str:
    """One row of the table."""
    count, causal = PROMPTS[name]
    with torch.device("meta"):
        layer = DecoderLayer(LLAMA)
    query, key, value = (
        torch.randn(1, LLAMA.heads, count, LLAMA.head_width).to(dtype) for _ in range(3)
    )
    if causal:
        key, value = KeyValueCache(LLAMA, LLAMA.max_positions, CPU, dtype).start(0, key, value)
    left, right = (torch.randn(SQUARE, SQUARE).to(dtype) for _ in range(2))
    scores, mixed = (
        torch.empty(LLAMA.heads, count, width, dtype=dtype) for width in (count, LLAMA.head_width)
    )

    def separately() -> None:
        torch.bmm(query[0], key[0].transpose(1, 2), out=scores)
        torch.bmm(torch.softmax(scores, dim=-1), value[0], out=mixed)

    check_same(layer.attend(query, key, value, causal), query, key, value, causal)
    took_ms = best_ms(
        {
            "square": lambda: torch.mm(left, right),
            "separately": separately,
            "softmax": lambda: torch.softmax(scores, dim=-1),
            "ours": lambda: layer.attend(query, key, value, causal),
        },
        repeat,
    )
    floor_ms = took_ms["square"] * 4 * count**2 * LLAMA.heads * LLAMA.head_width / (2 * SQUARE**3)
    cells = [floor_ms, took_ms["softmax"], took_ms["separately"], took_ms["ours"]]
    cells += [took_ms["ours"] / floor_ms, took_ms["ours"] / (floor_ms + took_ms["softmax"])]
    words = " | ".join(f"{cell:.2f}" for cell in cells)
    return (
        f"| {name}, {count} {'causal' if causal else 'all'} | "
        f"{str(dtype).removeprefix('torch.')} | {words} |"
    )


def check_same(ours: Tensor, query: Tensor, key: Tensor, value: Tensor, causal: bool) -> None:
    """Compare with plain attention in float64; see TOLERANCE."""
    query, key, value = (tensor.double() for tensor in (query, key, value))
    scores = query @ key.transpose(-1, -2) / query.shape[-1] ** 0.5
    if causal:
        scores = scores.masked_fill(
            torch.ones(scores.shape[-2:], dtype=torch.bool).triu(1), float("-inf")
        )
    off = (ours.double() - scores.softmax(dim=-1) @ value).abs().max().item()
    assert off < TOLERANCE[ours.dtype], f"attention is off by {off}"


def main() -> None:
    """Measure and print one Markdown table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--repeat", type=int, default=20)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    torch.manual_seed(0)
    amx = torch.cpu._is_amx_tile_supported()
    print(
        f"{platform.machine()} CPU with "
        f"{torch.backends.cpu.get_cpu_capability()}{' and AMX' if amx else ''}, "
        f"{options.threads} threads, torch {torch.__version__}; one layer of 32 heads of 128, "
        f"best of {options.repeat}\n"
    )
    heads = ["prompt", "type", "products ms", "softmax ms", "separately ms", "ours ms"]
    heads += ["ours / products", "ours / (products + softmax)"]
    print(f"| {' | '.join(heads)} |\n{'|---' * len(heads)}|")
    with torch.inference_mode():
        for name in PROMPTS:
            for dtype in (torch.float32, torch.bfloat16):
                print(measure(name, dtype, options.repeat), flush=True)


if __name__ == "__main__":
    main()
