"""A loaded pi0: maps images, token ids, a measured state and noise to normalised actions, one
sample at a time.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rn_backend_pi0.checkpoint import Family, Pi0Checkpoint
from rn_backend_pi0.chunking import Prefix
from rn_backend_pi0.flow import FlowNetwork
from rn_backend_pi0.image import Resize, to_pixels
from rn_backend_pi0.weights import load_network
from rn_vla.letterbox import Flip
from rn_vla.normalisation import Quantiles, Scaling, Values
from roboneuron import ConfigurationError, UngroundedError


def flow_times(family: Family, steps: int) -> tuple[float, ...]:
    """Times of `steps` Euler steps from 1 towards 0, exactly as the family's code rounds them to
    float32.

    The highest frequency of the time embedding is 1571 rad, so a rounding of 1e-7 in time is 2e-4
    in the embedding. Source: openpi subtracts 1/steps repeatedly in float32; LeRobot computes
    1 - k/steps and then rounds.
    """
    if family == "lerobot":
        return tuple(float(np.float32(1.0 + k * (-1.0 / steps))) for k in range(steps))
    times, time, step = [], np.float32(1.0), np.float32(-1.0 / steps)
    for _ in range(steps):
        times.append(float(time))
        time = np.float32(time + step)
    return tuple(times)


def with_eps(score: Scaling, family: Family) -> Scaling:
    """The same statistics with the family's eps.

    Source: openpi adds 1e-6 to the standard deviation or range both ways; LeRobot 1e-8 to the
    standard deviation when it divides, nothing on the way back and nothing to a range.
    """
    if isinstance(score, Quantiles):
        return replace(score, eps=1e-6 if family == "openpi" else 0.0)
    if family == "openpi":
        return replace(score, forward_eps=1e-6, backward_eps=1e-6)
    return replace(score, forward_eps=1e-8, backward_eps=0.0)


F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]


def resolve_device(name: str) -> torch.device:
    """The device called `name`; "auto" selects a GPU if there is one.

    Raises:
        ConfigurationError: a GPU is named that this PyTorch does not have.
    """
    available = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if name == "auto":
        return torch.device("cuda" if available else "cpu")
    device = torch.device(name)
    if device.type == "cuda" and (device.index or 0) >= available:
        raise ConfigurationError(
            f"Device {name!r} does not exist; PyTorch has {available} GPUs.", hint="Use 'cpu'."
        )
    return device


class Pi0Model:
    """Weights on a device, with the preprocessing of their family.

    Args:
        checkpoint: description of the checkpoint.
        device, dtype: device and number type of the computation ("auto" allowed).
        numerics: family whose rounding, resizing and eps are used; None for the one that wrote the
            checkpoint.
        resize: overrides the resizing alone.
        steps: Euler steps; None for the checkpoint's.
        cpu_threads: threads of PyTorch, for the whole process; None for no change.

    Raises:
        CheckpointError, ConfigurationError: see `weights.load_network` and `resolve_device`.
    """

    def __init__(
        self,
        checkpoint: Pi0Checkpoint,
        *,
        device: str = "auto",
        dtype: str = "auto",
        numerics: Family | None = None,
        resize: Resize | None = None,
        steps: int | None = None,
        cpu_threads: int | None = None,
    ) -> None:
        if cpu_threads is not None:
            torch.set_num_threads(cpu_threads)
        self.checkpoint = checkpoint
        self.device = resolve_device(device)
        narrow = dtype == "bfloat16" or (dtype == "auto" and self.device.type == "cuda")
        self.dtype = torch.bfloat16 if narrow else torch.float32
        family = numerics or checkpoint.family
        self._resize: Resize = resize or ("plain" if family == "lerobot" else "antialiased")
        self._times = flow_times(family, steps or checkpoint.denoising_steps)
        self.state = checkpoint.state if numerics is None else with_eps(checkpoint.state, family)
        self.action = checkpoint.action if numerics is None else with_eps(checkpoint.action, family)
        self._network = load_network(
            checkpoint.directory, checkpoint.dims, device=self.device, dtype=self.dtype
        )

    @property
    def noise_shape(self) -> tuple[int, int]:
        """Shape of the noise and of the normalised actions."""
        return self.checkpoint.dims.chunk, self.checkpoint.dims.action

    def infer(
        self,
        images: Sequence[U8 | None],
        token_ids: Sequence[int],
        state: Values,
        noise: F32,
        *,
        flip: Flip = "none",
        prefix: Prefix | None = None,
    ) -> F32:
        """Run one inference.

        Args:
            images: uint8 (H, W, 3) for each slot, in order; None for a missing camera.
            token_ids: the prompt without padding.
            state: (n,), in the training data's units; pi0.5 has it only in the prompt.
            noise: float32 of `noise_shape`.
            flip: rotation of upright images to those of the training data.
            prefix: rows to continue; None for an independent chunk.

        Returns:
            float32 of `noise_shape`, normalised.

        Raises:
            UngroundedError: no image at all.
        """
        dims = self.checkpoint.dims
        present = [
            to_pixels(i, side=dims.vision.image, resize=self._resize, flip=flip)
            for i in images
            if i is not None
        ]
        if not present:
            raise UngroundedError("All camera slots are empty; pi0 needs at least one image.")
        padded = np.zeros(dims.state, dtype=np.float32)
        padded[: len(state)] = self.state.head(len(state)).normalize(state)
        return self._answer(
            torch.from_numpy(np.stack(present)).to(self.device),
            torch.tensor(list(token_ids), dtype=torch.int64, device=self.device),
            padded,
            noise,
            prefix,
        )

    def _answer(
        self, pixels: Tensor, token_ids: Tensor, state: F32, noise: F32, prefix: Prefix | None
    ) -> F32:
        """Normalised actions, float32 of `noise_shape`."""
        network = self._network
        assert isinstance(network, FlowNetwork), type(network)
        actions = network.sample_actions(
            pixels,
            token_ids,
            torch.from_numpy(state).to(self.device),
            torch.from_numpy(noise).to(self.device),
            self._times,
            prefix,
        )
        return np.asarray(actions.cpu().numpy(), dtype=np.float32)

    def warm_up(self, images: int, token_count: int, state_width: int) -> float:
        """Run twice on grey images and the mean state; returns the second run's duration [ms].

        Raises:
            ConfigurationError: the device ran out of memory.
        """
        side = self.checkpoint.dims.vision.image
        grey: list[U8 | None] = [
            np.full((side, side, 3), 128, dtype=np.uint8) for _ in range(images)
        ]
        noise = np.zeros(self.noise_shape, dtype=np.float32)
        state = self.state.centre[:state_width].astype(np.float32)
        duration_ms = 0.0
        try:
            for _ in range(2):
                start = time.perf_counter()
                self.infer(grey, [0] * token_count, state, noise)
                duration_ms = (time.perf_counter() - start) * 1e3
        except torch.OutOfMemoryError as error:
            raise ConfigurationError(
                f"{self.device} has not enough free memory to run the model.",
                hint="Free it or use dtype = 'bfloat16'.",
            ) from error
        return duration_ms

    def release(self) -> None:
        """Free the device's memory; the model cannot be used afterwards."""
        del self._network
        if self.device.type == "cuda":
            torch.cuda.empty_cache()
