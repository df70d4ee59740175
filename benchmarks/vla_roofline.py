"""Measured peak speed of a device, and the lower bound of a request's time that follows from it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import torch

from rn_vla.decoding import PolicyModel, Request, RowsRequest
from rn_vla.openvla.layout import VisionShape

PRUNED_AFTER = 2


@dataclass(frozen=True, kw_only=True, slots=True)
class Speed:
    """Measured speed of the device: bandwidth [byte/s] and throughput [FLOP/s]."""

    bandwidth: float
    throughput: float

    def bound_s(
        self, parameters: float, tokens: float, attention_flop: float, itemsize: int
    ) -> float:
        """Shortest time for `tokens` rows through `parameters` weights [s]."""
        flop = 2 * parameters * tokens + attention_flop
        return max(parameters * itemsize / self.bandwidth, flop / self.throughput)


def now_s() -> float:
    """CPU time when a single CPU thread computes, else wall time [s]."""
    return (
        time.perf_counter()
        if torch.cuda.is_available() or torch.get_num_threads() > 1
        else time.process_time()
    )


def measure_speed(device: torch.device, dtype: torch.dtype) -> Speed:
    """Best of ten runs: a matrix-vector product of 256 MB or more for the bandwidth, a square
    matrix product for the throughput.
    """
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
    """Wait until the device has finished its work."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def roofline_ms(
    model: PolicyModel, vision: VisionShape, request: Request, share: float, speed: Speed, item: int
) -> float:
    """Lower bound of the time of one request [ms]: the sum of the bounds of its parts."""
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
