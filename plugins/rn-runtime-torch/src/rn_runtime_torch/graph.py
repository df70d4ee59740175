"""CUDA graphs: a computation with fixed shapes is recorded once, and replayed without Python and
launch overhead.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass

import torch
from torch import Tensor

Computation = Callable[[dict[str, Tensor]], dict[str, Tensor]]

_WARM_RUNS = 2
"""Runs on a side stream before capture, in which libraries allocate workspaces and choose
kernels.
"""


@dataclass(frozen=True, slots=True, eq=False)
class _RecordedGraph:
    graph: torch.cuda.CUDAGraph
    inputs: dict[str, Tensor]
    outputs: dict[str, Tensor]
    note: int


class GraphCache:
    """Recorded computations by key; they share one memory pool and one stream, so libraries'
    workspaces exist once.

    Nothing is recorded by `run`: recording takes as long as several requests, and the robot may be
    moving.

    Attributes:
        was_replayed: whether the last `run` found a recording.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self.was_replayed = False
        self._recorded: dict[Hashable, _RecordedGraph] = {}
        self._pool = torch.cuda.graph_pool_handle()
        self._side: torch.cuda.Stream = torch.cuda.Stream(device)  # type: ignore[no-untyped-call]

    def __len__(self) -> int:
        return len(self._recorded)

    def __contains__(self, key: Hashable) -> bool:
        return key in self._recorded

    def keys(self) -> tuple[Hashable, ...]:
        """Keys of the recordings."""
        return tuple(self._recorded)

    def record(
        self,
        key: Hashable,
        compute: Computation,
        inputs: dict[str, Tensor],
        note: Callable[[], int],
    ) -> None:
        """Record the computation for `key`.

        Args:
            key: everything that affects shapes or control flow.
            compute: pure except for buffers that never move; runs only while recording.
            inputs: tensors on the device, with the shapes of `key`.
            note: returns a number known after `compute` ran in Python; stored with the recording.
        """
        with torch.cuda.device(self._device):
            self._recorded[key] = self._record(compute, inputs, note)

    def run(self, key: Hashable, inputs: dict[str, Tensor]) -> tuple[dict[str, Tensor], int] | None:
        """Replay the recording of `key`; None if there is none.

        Returns:
            Outputs, valid until the next call, and the note.
        """
        found = self._recorded.get(key)
        self.was_replayed = found is not None
        if found is None:
            return None
        for name, tensor in inputs.items():
            found.inputs[name].copy_(tensor)
        found.graph.replay()
        return found.outputs, found.note

    def _record(
        self, compute: Computation, inputs: dict[str, Tensor], note: Callable[[], int]
    ) -> _RecordedGraph:
        held = {name: tensor.clone() for name, tensor in inputs.items()}
        self._side.wait_stream(torch.cuda.current_stream(self._device))
        with torch.cuda.stream(self._side):
            for _ in range(_WARM_RUNS):
                compute(held)
        graph = torch.cuda.CUDAGraph()
        # On the stream of the warm runs, where the workspaces exist and stay outside the graphs'
        # pool.
        with torch.cuda.graph(
            graph, pool=self._pool, stream=self._side, capture_error_mode="thread_local"
        ):
            outputs = compute(held)
        torch.cuda.current_stream(self._device).wait_stream(self._side)
        return _RecordedGraph(graph, held, outputs, note())
