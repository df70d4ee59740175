"""Common base of the backends that run a checkpoint in this process."""

from __future__ import annotations

import logging
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from rn_backend_pi0.architecture import Variant
from rn_backend_pi0.checkpoint import Pi0Checkpoint
from rn_backend_pi0.chunking import Prefix, RunningChunk
from rn_backend_pi0.conversion import Conversion
from rn_backend_pi0.layouts import read_checkpoint
from rn_backend_pi0.options import NativeOptions
from rn_vla.normalisation import Scaling, Values
from roboneuron import (
    ActionChunk,
    Ahead,
    CheckpointError,
    ConfigurationError,
    Observation,
    StateError,
    UngroundedError,
    UnsafeError,
)

if TYPE_CHECKING:
    from rn_backend_pi0.model import Pi0Model
    from rn_backend_pi0.prompt import InstructionEncoder

EMPTY = "-"
_ROLE_BY_SLOT = {
    "base_0_rgb": "primary",
    "left_wrist_0_rgb": "wrist",
    "right_wrist_0_rgb": "right_wrist",
    "base_1_rgb": EMPTY,
    "wrist_0_rgb": "wrist",
    "image": "primary",
    "image2": "wrist",
    "wrist_image": "wrist",
}
_FAR_FROM_TRAINING = 10.0
"""Deviation of the state, in standard deviations, above which the chunk's note contains a
warning.
"""
log = logging.getLogger(__name__)


def resolve_slots(slots: Sequence[str], wanted: Sequence[str] | None) -> tuple[str, ...]:
    """Camera role for each slot of a checkpoint, EMPTY for none.

    Args:
        slots: the checkpoint's names.
        wanted: the user's choice; None for the default roles of known names.

    Raises:
        ConfigurationError: wrong number, a repeated role, no role at all, or an unknown name
            without a choice.
    """
    shown = ", ".join(slots)
    if wanted is None:
        unknown = [
            name
            for name in slots
            if name not in _ROLE_BY_SLOT and not name.startswith("empty_camera_")
        ]
        if unknown:
            raise ConfigurationError(
                f"The roles of the checkpoint's camera slots {', '.join(unknown)} are not known.",
                hint="Set camera_slots to a role ('primary', 'wrist') or '-' for each of: "
                f"{shown}.",
            )
        roles = tuple(_ROLE_BY_SLOT.get(name, EMPTY) for name in slots)
    else:
        roles = tuple(wanted)
        if len(roles) != len(slots):
            raise ConfigurationError(
                f"camera_slots has {len(roles)} entries, the checkpoint {len(slots)} slots: "
                f"{shown}."
            )
    used = [role for role in roles if role != EMPTY]
    if not used or len(set(used)) != len(used):
        raise ConfigurationError(
            f"The camera slots ({shown}) get the roles {roles}; each role once, at least one."
        )
    return roles


def _fit(
    score: Scaling, columns: Sequence[str], padded: int, what: str, checkpoint: Pi0Checkpoint
) -> None:
    """Compare statistics with a profile's columns. Raises CheckpointError."""
    width = len(columns)
    if score.width != width and score.width != padded:
        raise CheckpointError(
            f"{checkpoint.directory} has statistics of {score.width} {what} values, the profile "
            f"has {width}.",
            hint="Choose the profile that belongs to the checkpoint, or describe it with profile "
            "= 'own'.",
        )
    flat = score.is_flat
    still = [f"{i} ({name})" for i, name in enumerate(columns) if name != "padding" and flat[i]]
    if still:
        raise CheckpointError(
            f"{checkpoint.directory}: the {score.spread} of the {what} values "
            f"{', '.join(still)} is 0, so they "
            "cannot be normalised.",
            hint="Copy the statistics of the original checkpoint again, or choose the profile "
            "that belongs to it.",
        )


class NativeBackend(ABC):
    """Implements the protocol `Backend`; the constructor only stores the options, `load` does the
    work.

    Differences between models are in `build_model`, `draw_noise` and `prefix_of`.
    """

    name: ClassVar[str]
    """Name in the descriptor."""
    variants: ClassVar[tuple[Variant, ...]]
    """Supported model variants."""

    def __init__(
        self, config: NativeOptions, *, runtime: object = None, acceleration: object = None
    ) -> None:
        if runtime is not None or acceleration is not None:
            raise ConfigurationError(f"Backend {self.name!r} takes no runtime and no acceleration.")
        self._options = config
        self._model: Pi0Model | None = None
        self._prompt: InstructionEncoder | None = None
        self._conversion: Conversion | None = None
        self._slots: tuple[str, ...] = ()
        self._warm_ms = 0.0

    def load(self) -> None:
        """Read the checkpoint, move it to the device and warm it up.

        Raises:
            CheckpointError, ConfigurationError: see `read_checkpoint`, `load_prompt`, `Pi0Model`.
        """
        from rn_backend_pi0.prompt import load_prompt  # heavy

        config = self._options
        checkpoint = read_checkpoint(config.checkpoint, asset_id=config.asset_id)
        if checkpoint.dims.variant not in self.variants:
            raise CheckpointError(
                f"{checkpoint.directory} holds a {checkpoint.dims.variant} model, backend "
                f"{self.name!r} runs {', '.join(self.variants)}.",
                hint="Use the backend 'pi0-fast' for pi0_fast, 'pi0' for the others.",
            )
        conversion = config.resolve_conversion(checkpoint.profile)
        if checkpoint.relative_actions and not len(conversion.relative):
            raise ConfigurationError(
                f"{checkpoint.directory} was trained on actions relative to the state, the "
                "profile's are not.",
                hint="Choose profile 'libero-openpi', one of relative joints, or 'own' with "
                "adds_state = true.",
            )
        dims = checkpoint.dims
        _fit(checkpoint.state, conversion.state_columns, dims.state, "state", checkpoint)
        _fit(checkpoint.action, conversion.action_columns, dims.action, "action", checkpoint)
        self._slots = resolve_slots(checkpoint.slots, config.camera_slots)
        if config.action_steps is not None and config.action_steps > dims.chunk:
            raise ConfigurationError(
                f"action_steps is {config.action_steps}, the model yields {dims.chunk} actions."
            )
        self._prompt = load_prompt(
            checkpoint.directory,
            config.tokenizer,
            family=checkpoint.family,
            max_tokens=checkpoint.prompt_length,
            vocabulary=dims.vocabulary,
            variant=self.prompt_like(dims.variant),
        )
        self._model = self.build_model(checkpoint, self._prompt)
        self._conversion = conversion
        cameras = sum(role != EMPTY for role in self._slots)
        width = len(conversion.state_columns)
        self._warm_ms = self._model.warm_up(cameras, checkpoint.prompt_length, width)
        log.info(
            "%s on %s in %s, warm inference %.0f ms",
            dims.variant,
            self._model.device,
            self._model.dtype,
            self._warm_ms,
        )
        self.reset()

    def predict(self, observation: Observation) -> ActionChunk:
        """Return the next actions.

        Raises:
            UngroundedError: a camera, the pose, joints or the gripper is missing, or the
                instruction is too long.
            UnsafeError: the measured state or the model's output is not finite.
            StateError: `load` was not called.
        """
        if self._model is None or self._prompt is None or self._conversion is None:
            raise StateError(f"Backend {self.name!r} is not loaded; call load() first.")
        start = time.perf_counter()
        model, conversion = self._model, self._conversion
        images = self._images(observation)
        state = conversion.read_state(observation)
        narrow = state.astype(conversion.precision)
        inside = model.state.head(len(narrow)).normalize(narrow)
        token_ids = self._prompt.encode(observation.instruction, inside)
        prefix = self.prefix_of(observation.ahead, narrow)
        normalized = model.infer(
            images,
            token_ids,
            narrow,
            self.draw_noise(model.noise_shape),
            flip=self._options.image_flip,
            prefix=prefix,
        )
        if not np.isfinite(normalized).all():
            raise UnsafeError(
                f"The {self.name} model produced non-finite values; nothing is executed."
            )
        steps = self._options.action_steps or model.checkpoint.action_steps
        width = len(conversion.action_columns)
        answer = normalized[:steps, :width].astype(conversion.precision)
        raw = model.action.head(width).denormalize(answer).astype(np.float64)
        actions = conversion.to_contract(raw, state, observation)
        deviation = float(np.abs(inside).max())
        note = ""
        if deviation > _FAR_FROM_TRAINING:
            note = (
                f"proprioception is {deviation:.0f} {model.state.measure} from the training "
                "data; check the profile"
            )
        return ActionChunk(
            actions=actions,
            step_s=conversion.step_s,
            space=conversion.space,
            metrics={
                "inference_ms": (time.perf_counter() - start) * 1e3,
                "chunk_horizon": float(len(actions)),
                "cameras": float(sum(image is not None for image in images)),
                "prompt_tokens": float(len(token_ids)),
                "state_deviation": deviation,
            },
            note=note,
            context=RunningChunk(normalized=normalized, state=narrow),
            conditioned_rows=0 if prefix is None else min(prefix.committed, len(actions)),
        )

    def close(self) -> None:
        """Release the weights."""
        if self._model is not None:
            self._model.release()
        self._model = self._prompt = self._conversion = None

    def _images(self, observation: Observation) -> list[NDArray[np.uint8] | None]:
        images: list[NDArray[np.uint8] | None] = []
        for role in self._slots:
            frame = observation.frames.get(role)
            if frame is None and role != EMPTY and role not in self._options.optional_roles:
                have = ", ".join(observation.frames) or "none"
                raise UngroundedError(
                    f"pi0 needs a frame of the camera role {role!r}; the observation has: {have}."
                )
            images.append(None if frame is None else frame.image)
        return images

    def prompt_like(self, variant: Variant) -> Variant:
        """The variant whose prompt format a model of this variant uses."""
        return variant

    @abstractmethod
    def build_model(self, checkpoint: Pi0Checkpoint, prompt: InstructionEncoder) -> Pi0Model:
        """The model on its device. Raises CheckpointError, ConfigurationError: see `Pi0Model`."""

    @abstractmethod
    def reset(self) -> None:
        """Reset the episode's state."""

    @abstractmethod
    def draw_noise(self, shape: tuple[int, int]) -> NDArray[np.float32]:
        """Initial noise of the next inference, float32 of `shape`."""

    @abstractmethod
    def prefix_of(self, ahead: Ahead | None, state: Values) -> Prefix | None:
        """The rest of the running chunk in the model's own form; None if there is none to
        continue.
        """
