"""Calls to a loaded LeRobot policy: chunks, batches, single actions.

Source: lerobot 0.6.1, `policies/factory.py` and `policies/utils.py`; its own loops are
`rollout/inference/sync.py` and `rtc.py`.
"""

from __future__ import annotations

import contextlib
import inspect
import sys
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from rn_backend_lerobot.checkpoint import STATE, PolicyFolder
from rn_backend_lerobot.exchange import ChunkPrefix, PolicyChunk, PolicyObservation
from rn_backend_lerobot.isolation import (
    Noise,
    offline,
    own_folder,
)
from rn_backend_lerobot.loading import load_policy
from rn_backend_lerobot.options import LeRobotOptions
from roboneuron import ConfigurationError

if TYPE_CHECKING:
    import torch

_ALL_ROWS = 10_000
"""Larger than the number of rows of any chunk."""


class _RelativeStep(Protocol):
    action_names: list[str] | None

    def get_cached_state(self) -> object: ...


class PolicyEngine:
    """A loaded policy with its processors; for use from one thread.

    Args:
        folder: the checkpoint.
        options: device, seed, chunking.
        names: names of the action's values, in order.
    """

    def __init__(self, folder: PolicyFolder, options: LeRobotOptions, names: Sequence[str]) -> None:
        import torch  # heavy

        self._torch = torch
        self._folder, self._options, self._names = folder, options, list(names)
        self._device = _device(options.device)
        if options.threads is not None:
            torch.set_num_threads(options.threads)
        self._noise = Noise(torch, options.seed, self._device)
        with (
            offline(),
            own_folder(),
            contextlib.redirect_stdout(sys.stderr),
            torch.random.fork_rng(devices=[]),
        ):
            self._policy, self._before, self._after = load_policy(folder, self._device)
        self._relative, self._normalizer = self._find_steps()
        self.can_continue = options.rtc and self._enable_rtc()
        self.reset()

    @property
    def device(self) -> str:
        """Device of the policy."""
        return self._device

    def chunk(self, seen: PolicyObservation, prefix: ChunkPrefix | None = None) -> PolicyChunk:
        """Predict a whole chunk, which continues the prefix if the policy can."""
        with self._torch.no_grad(), self._precision(), self._noise.drawn():
            batch = self._prepare(seen)
            more: dict[str, object] = {}
            if prefix is not None and self.can_continue:
                more = {
                    "inference_delay": prefix.committed,
                    "prev_chunk_left_over": self._left_over(prefix),
                }
            actions = self._policy.predict_action_chunk(batch, **more)
            return self._finish(actions)[0]

    def chunks(self, seen: Sequence[PolicyObservation]) -> list[PolicyChunk]:
        """Predict a chunk for each observation, in one pass if the shapes of their tensors are
        equal.
        """
        with self._torch.no_grad(), self._precision(), self._noise.drawn():
            batches = [self._prepare(one) for one in seen]
            shapes = {_shapes(batch) for batch in batches}
            if len(shapes) == 1 and self._relative is None:
                return self._finish(self._policy.predict_action_chunk(_stacked(batches)))
        # a relative step stores the state of one observation at a time
        return [self.chunk(one) for one in seen]

    def action(self, seen: PolicyObservation) -> PolicyChunk:
        """Return one action of a policy that keeps its own history, as a chunk of one row."""
        with self._torch.no_grad(), self._precision(), self._noise.drawn():
            action = self._policy.select_action(self._prepare(seen))
            return self._finish(action.unsqueeze(1))[0]

    def reset(self) -> None:
        """Clear observations and planned actions; seeded noise restarts."""
        for part in (self._policy, self._before, self._after):
            part.reset()
        self._noise.restart()

    def _prepare(self, seen: PolicyObservation) -> Mapping[str, object]:
        """Convert an observation to LeRobot's batch of one."""
        from lerobot.policies.utils import prepare_observation_for_inference

        # copied: PyTorch shares memory only with arrays that may be written to
        observation: dict[str, NDArray[np.generic]] = {
            key: np.array(image) for key, image in seen.images.items()
        }
        if seen.state is not None:
            observation[STATE] = seen.state
        prepared = prepare_observation_for_inference(
            observation, self._torch.device(self._device), seen.task, self._options.robot_type
        )
        return cast("Mapping[str, object]", self._before(prepared))

    def _finish(self, actions: torch.Tensor) -> list[PolicyChunk]:
        """Postprocess normalised actions (B, T, A) to one answer per observation."""
        after = cast("torch.Tensor", self._after(actions.clone()))
        rows = after.detach().to("cpu", self._torch.float64).numpy()
        kept = actions.detach()
        return [PolicyChunk(normalized=kept[i], rows=rows[i]) for i in range(len(rows))]

    def _left_over(self, prefix: ChunkPrefix) -> torch.Tensor:
        """The rest of the running chunk, normalised, and relative to the present state if the
        policy's actions are relative. It is never padded: zeros would mean the mean of the training
        data.
        """
        if self._relative is None:
            return prefix.answer.normalized[prefix.first :]
        from lerobot.policies.rtc import reanchor_relative_rtc_prefix

        left = self._torch.from_numpy(prefix.answer.rows[prefix.first :].astype(np.float32))
        return cast(
            "torch.Tensor",
            reanchor_relative_rtc_prefix(
                prev_actions_absolute=left,
                current_state=self._relative.get_cached_state(),
                relative_step=self._relative,
                normalizer_step=self._normalizer,
                policy_device=self._device,
            ),
        )

    @contextlib.contextmanager
    def _precision(self) -> Iterator[None]:
        """Use mixed precision if the checkpoint was trained with it and the device is a GPU."""
        is_mixed = self._policy.config.use_amp and self._device.startswith("cuda")
        if not is_mixed:
            yield
            return
        with self._torch.autocast(device_type="cuda"):
            yield

    def _find_steps(self) -> tuple[_RelativeStep | None, object | None]:
        """Find the steps for relative actions; set the names if the checkpoint has none."""
        from lerobot.processor import NormalizerProcessorStep, RelativeActionsProcessorStep

        normalizer = None
        relative: _RelativeStep | None = None
        for step in self._before.steps:
            if isinstance(step, NormalizerProcessorStep):
                normalizer = step
            elif isinstance(step, RelativeActionsProcessorStep) and step.enabled:
                relative = cast("_RelativeStep", step)
        if relative is not None and relative.action_names is None:
            relative.action_names = self._names
        return relative, normalizer

    def _enable_rtc(self) -> bool:
        """Enable real-time chunking; returns False for a policy without it."""
        policy = self._policy
        if self._folder.remembers or not getattr(policy, "supports_rtc", lambda: False)():
            return False
        try:
            inspect.signature(policy.predict_action_chunk).bind(
                {}, inference_delay=0, prev_chunk_left_over=None
            )
        except TypeError:
            return False
        start = getattr(policy, "init_rtc_processor", None)
        if start is None:
            return False
        from lerobot.configs import RTCAttentionSchedule
        from lerobot.policies.rtc.configuration_rtc import RTCConfig

        options = self._options
        policy.config.rtc_config = RTCConfig(
            enabled=True,
            # lerobot limits it to the rows that are left
            execution_horizon=options.rtc_horizon or _ALL_ROWS,
            prefix_attention_schedule=RTCAttentionSchedule[options.rtc_schedule.upper()],
            max_guidance_weight=options.rtc_max_weight,
        )
        start()
        return True


def _device(wanted: str) -> str:
    """Resolve "auto". Raises ConfigurationError for a GPU that does not exist."""
    import torch  # heavy

    if wanted == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    if wanted != "cpu" and not torch.cuda.is_available():
        raise ConfigurationError(f"The option 'device' is {wanted!r}, and PyTorch finds no GPU.")
    return wanted


def _shapes(batch: Mapping[str, object]) -> tuple[tuple[str, tuple[int, ...]], ...]:
    """Names and shapes of a batch's tensors."""
    import torch

    return tuple(
        (key, tuple(value.shape)) for key, value in batch.items() if isinstance(value, torch.Tensor)
    )


def _stacked(batches: Sequence[Mapping[str, object]]) -> dict[str, object]:
    """Concatenate batches of one to one batch."""
    import torch

    out: dict[str, object] = {}
    for key, first in batches[0].items():
        values = [batch[key] for batch in batches]
        if isinstance(first, torch.Tensor):
            out[key] = torch.cat([cast("torch.Tensor", value) for value in values])
        elif isinstance(first, list):
            out[key] = [item for value in values for item in cast("list[object]", value)]
        else:
            out[key] = first
    return out
