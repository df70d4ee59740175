"""The monitor's network for inference, with NumPy only: a server that uses it imports no torch.

Two small stacks of convolutions (the close view and the whole picture) and the measured state lead
to three numbers for each colour.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rn_policy_cubes.monitor.views import CLOSE_PX, WHOLE_PX

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]

CLOSE_CHANNELS = (16, 32, 48, 64)
WHOLE_CHANNELS = (16, 24, 32)
"""Channels after each convolution of 3 x 3 pixels with stride 2."""
WHOLE_WIDTH, HIDDEN_WIDTH, STATE_WIDTH = 48, 96, 4
OUTPUTS = ("lifted", "progress", "missing")
"""Outputs for each colour: logit that its cube is held 10 cm up; progress of lifting it; logit that
the closed hand is up without it.
"""
_STATE_CENTRE = np.array([0.5, 0.0, 0.2, 0.5], dtype=np.float32)
_STATE_SCALE = np.array([5.0, 4.0, 8.0, 2.0], dtype=np.float32)


def state_of(tcp_m: NDArray[np.floating], opening: NDArray[np.floating]) -> F32:
    """The state's input (n, 4): TCP positions (n, 3) [m] in the base frame and openings (n,)."""
    raw = np.column_stack([tcp_m, opening]).astype(np.float32)
    return np.asarray((raw - _STATE_CENTRE) * _STATE_SCALE, dtype=np.float32)


def scaled(views: U8) -> F32:
    """Pictures (n, side, side, 3) as input (n, 3, side, side), -1 .. 1."""
    turned = views.transpose(0, 3, 1, 2).astype(np.float32)
    return np.asarray(turned / 127.5 - 1.0, dtype=np.float32)


def flat_widths() -> tuple[int, int]:
    """Numbers after the last convolution of the close view, and of the whole picture."""
    sides = []
    for side, channels in ((CLOSE_PX, CLOSE_CHANNELS), (WHOLE_PX, WHOLE_CHANNELS)):
        for _ in channels:
            side = (side + 1) // 2
        sides.append(side * side * channels[-1])
    return sides[0], sides[1]


@dataclass(frozen=True, slots=True, eq=False)
class MonitorLayers:
    """The trained tensors, float32 by name, as `fitting.MonitorNetwork` names them."""

    tensors: Mapping[str, F32]

    def __call__(self, close: U8, whole: U8, state: F32) -> F32:
        """The outputs (n, 3, colours) for views (n, 48, 48, 3), (n, 56, 56, 3) and states (n, 4);
        progress is 0 .. 1, the others are logits.
        """
        near = self._stack("close", scaled(close), len(CLOSE_CHANNELS))
        far = self._stack("whole", scaled(whole), len(WHOLE_CHANNELS))
        far = np.maximum(self._linear("squeeze", far), 0.0)
        hidden = self._linear("hidden", np.concatenate([near, far, state], axis=1))
        told = self._linear("out", np.maximum(hidden, 0.0))
        told = told.reshape(len(told), len(OUTPUTS), -1)
        told[:, 1] = _sigmoid(told[:, 1])
        return told

    def _linear(self, name: str, value: F32) -> F32:
        product = value @ self.tensors[f"{name}.weight"].T
        return np.asarray(product + self.tensors[f"{name}.bias"], dtype=np.float32)

    def _stack(self, name: str, value: F32, count: int) -> F32:
        for index in range(count):
            weight = self.tensors[f"{name}.{index}.weight"]
            bias = self.tensors[f"{name}.{index}.bias"]
            value = np.maximum(_halving(value, weight, bias), 0.0)
        return value.reshape(len(value), -1)


def _halving(value: F32, weight: F32, bias: F32) -> F32:
    """Convolution of 3 x 3 pixels with stride 2 and a border of one zero: (n, c, s, s)."""
    padded = np.pad(value, ((0, 0), (0, 0), (1, 1), (1, 1)))
    windows = np.lib.stride_tricks.sliding_window_view(padded, (3, 3), axis=(2, 3))
    chosen = windows[:, :, ::2, ::2].transpose(0, 2, 3, 1, 4, 5)
    count, rows, columns = chosen.shape[:3]
    flat = chosen.reshape(count * rows * columns, -1)
    made = flat @ weight.reshape(len(weight), -1).T + bias
    return np.ascontiguousarray(made.reshape(count, rows, columns, -1).transpose(0, 3, 1, 2))


def _sigmoid(value: F32) -> F32:
    return np.asarray(1.0 / (1.0 + np.exp(-np.clip(value, -30, 30))), dtype=np.float32)
