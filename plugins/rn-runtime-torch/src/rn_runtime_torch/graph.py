"""CUDA graphs: a computation of fixed shapes is recorded once and replayed without Python or launch cost."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass

import torch
from torch import Tensor

Computation = Callable[[dict[str, Tensor]], dict[str, Tensor]]

_MOST_GRAPHS = 64
_WARM_RUNS = 2
"""Runs on a side stream before capture: libraries allocate their workspaces and choose kernels in them."""


@dataclass(frozen=True, slots=True, eq=False)
class _Recorded:
    graph: torch.cuda.CUDAGraph
    inputs: dict[str, Tensor]
    outputs: dict[str, Tensor]
    note: int


class GraphCache:
    """Recorded computations by key, least recently used ones dropped; they share one memory pool."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._recorded: OrderedDict[Hashable, _Recorded] = OrderedDict()
        self._pool = torch.cuda.graph_pool_handle()

    def __len__(self) -> int:
        return len(self._recorded)

    def run(
        self, key: Hashable, compute: Computation, inputs: dict[str, Tensor], note: Callable[[], int]
    ) -> tuple[dict[str, Tensor], int]:
        """Replay the computation recorded for `key`, recording it first when it is new.

        Args:
            key: everything that changes shapes or control flow.
            compute: pure up to buffers that never move; run only while recording.
            inputs: tensors on the device, of the shapes that belong to `key`.
            note: a number known after `compute` ran in Python; kept with the recording.

        Returns:
            Outputs, valid until the next call, and the note.
        """
        if key not in self._recorded:
            with torch.cuda.device(self._device):
                self._recorded[key] = self._record(compute, inputs, note)
            if len(self._recorded) > _MOST_GRAPHS:
                self._recorded.popitem(last=False)
        self._recorded.move_to_end(key)
        found = self._recorded[key]
        for name, tensor in inputs.items():
            found.inputs[name].copy_(tensor)
        found.graph.replay()
        return found.outputs, found.note

    def _record(self, compute: Computation, inputs: dict[str, Tensor], note: Callable[[], int]) -> _Recorded:
        held = {name: tensor.clone() for name, tensor in inputs.items()}
        side = torch.cuda.Stream(self._device)  # type: ignore[no-untyped-call]
        side.wait_stream(torch.cuda.current_stream(self._device))
        with torch.cuda.stream(side):
            for _ in range(_WARM_RUNS):
                compute(held)
        torch.cuda.current_stream(self._device).wait_stream(side)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, pool=self._pool, capture_error_mode="thread_local"):
            outputs = compute(held)
        return _Recorded(graph, held, outputs, note())
