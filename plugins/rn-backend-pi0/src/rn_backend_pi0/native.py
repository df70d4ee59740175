"""The backend "pi0": a checkpoint in this process."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rn_backend_pi0.checkpoint import Pi0Checkpoint
from rn_backend_pi0.chunking import Prefix, RunningChunk
from rn_backend_pi0.layouts import read_checkpoint
from rn_backend_pi0.options import Pi0Options
from rn_backend_pi0.profiles import Profile
from rn_backend_pi0.statistics import ZScore
from roboneuron import (
    ACTION_FIELDS,
    ACTION_SIZE,
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
    "right_wrist_0_rgb": EMPTY,
    "image": "primary",
    "image2": "wrist",
    "wrist_image": "wrist",
}
_FAR_FROM_TRAINING = 10.0
"""Standard deviations of the state beyond which the chunk's note says that something is off."""
log = logging.getLogger(__name__)


def resolve_slots(slots: Sequence[str], wanted: Sequence[str] | None) -> tuple[str, ...]:
    """Camera role for each slot of a checkpoint, EMPTY for none.

    Args:
        slots: the checkpoint's names.
        wanted: the user's choice; None for the usual roles of well-known names.

    Raises:
        ConfigurationError: wrong number, a role twice, no role at all, or an unknown name without a
            choice.
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
    score: ZScore, columns: Sequence[str], padded: int, what: str, checkpoint: Pi0Checkpoint
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
    still = [
        f"{i} ({name})" for i, name in enumerate(columns) if name != "padding" and score.std[i] == 0
    ]
    if still:
        raise CheckpointError(
            f"{checkpoint.directory}: the standard deviation of the {what} values "
            f"{', '.join(still)} is 0, so they "
            "cannot be normalised.",
            hint="Copy the statistics of the original checkpoint again, or choose the profile "
            "that belongs to it.",
        )


class Pi0Backend:
    """Follows the protocol `Backend`; construction is pure, `load` does the work."""

    def __init__(
        self, config: Pi0Options, *, runtime: object = None, acceleration: object = None
    ) -> None:
        if runtime is not None or acceleration is not None:
            raise ConfigurationError("Backend 'pi0' takes no runtime and no acceleration.")
        self._config = config
        self._model: Pi0Model | None = None
        self._prompt: InstructionEncoder | None = None
        self._profile: Profile | None = None
        self._slots: tuple[str, ...] = ()
        self._random = np.random.default_rng(config.numpy_seed)
        self._warm_ms = 0.0

    def load(self) -> None:
        """Read the checkpoint, put it on the device and warm it up.

        Raises:
            CheckpointError, ConfigurationError: see `read_checkpoint`, `load_prompt`, `Pi0Model`.
        """
        from rn_backend_pi0.model import Pi0Model  # heavy
        from rn_backend_pi0.prompt import load_prompt

        config = self._config
        checkpoint = read_checkpoint(config.checkpoint, asset_id=config.asset_id)
        profile = config.resolve_profile(checkpoint.profile)
        if checkpoint.relative_actions and not profile.action.adds_state:
            raise ConfigurationError(
                f"{checkpoint.directory} was trained on actions relative to the state, the "
                "profile's are not.",
                hint="Choose profile 'libero-openpi', or 'own' with adds_state = true.",
            )
        dims = checkpoint.dims
        _fit(checkpoint.state, profile.state.columns, dims.state, "state", checkpoint)
        _fit(checkpoint.action, ACTION_FIELDS, dims.action, "action", checkpoint)
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
        )
        self._model = Pi0Model(
            checkpoint,
            device=config.device,
            dtype=config.dtype,
            numerics=config.numerics,
            resize=config.resize,
            steps=config.denoising_steps,
            cpu_threads=config.cpu_threads,
        )
        self._profile = profile
        cameras = sum(role != EMPTY for role in self._slots)
        self._warm_ms = self._model.warm_up(cameras, checkpoint.prompt_length, profile.state.width)
        log.info(
            "pi0 on %s in %s, warm inference %.0f ms",
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
        if self._model is None or self._prompt is None or self._profile is None:
            raise StateError("Backend 'pi0' is not loaded; call load() first.")
        start = time.perf_counter()
        model, profile, base = self._model, self._profile, np.array(self._config.base_position_m)
        images = self._images(observation)
        token_ids = self._prompt.encode(observation.instruction)
        state = profile.state.build(observation)
        narrow = state.astype(np.float32)
        prefix = self._prefix(observation.ahead, narrow)
        normalized = model.infer(
            images,
            token_ids,
            narrow,
            self._noise(model.noise_shape),
            flip=self._config.image_flip,
            prefix=prefix,
        )
        if not np.isfinite(normalized).all():
            raise UnsafeError("The pi0 model produced non-finite values; nothing is executed.")
        steps = self._config.action_steps or model.checkpoint.action_steps
        raw = (
            model.action.head(ACTION_SIZE)
            .denormalize(normalized[:steps, :ACTION_SIZE])
            .astype(np.float64)
        )
        actions = profile.action.to_contract(
            raw, state=state, pose=observation.ee_pose, base_position_m=base
        )
        deviation = float(np.abs(model.state.head(len(narrow)).normalize(narrow)).max())
        note = ""
        if deviation > _FAR_FROM_TRAINING:
            note = (
                f"proprioception is {deviation:.0f} standard deviations from the training "
                "data; check the profile"
            )
        return ActionChunk(
            actions=actions,
            step_s=profile.action.step_s,
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

    def reset(self) -> None:
        """Start the noise anew, so that an episode with a seed repeats itself."""
        self._random = np.random.default_rng(self._config.numpy_seed)

    def close(self) -> None:
        """Release the weights."""
        if self._model is not None:
            self._model.release()
        self._model = self._prompt = self._profile = None

    def _images(self, observation: Observation) -> list[NDArray[np.uint8] | None]:
        images: list[NDArray[np.uint8] | None] = []
        for role in self._slots:
            frame = observation.frames.get(role)
            if frame is None and role != EMPTY and role not in self._config.optional_roles:
                have = ", ".join(observation.frames) or "none"
                raise UngroundedError(
                    f"pi0 needs a frame of the camera role {role!r}; the observation has: {have}."
                )
            images.append(None if frame is None else frame.image)
        return images

    def _prefix(self, ahead: Ahead | None, state: NDArray[np.float32]) -> Prefix | None:
        """The rest of the running chunk in the model's own form; None when there is none to
        continue.
        """
        config, model, profile = self._config, self._model, self._profile
        running = None if ahead is None else ahead.context
        if (
            not config.rtc
            or ahead is None
            or not isinstance(running, RunningChunk)
            or model is None
            or profile is None
        ):
            return None
        rows = running.normalized[ahead.context_row :]
        if not len(rows):
            return None
        if profile.action.adds_state:  # the rows are relative to a state that has changed meanwhile
            score, rows = model.action.head(6), rows.copy()
            moved = (running.state - state)[:6] / (score.std + np.float32(score.backward_eps))
            rows[:, :6] += moved
        trained = model.checkpoint.trained_prefix_rows
        return Prefix(
            rows=rows,
            committed=min(ahead.committed_rows, trained) if trained else ahead.committed_rows,
            horizon=config.rtc_horizon,
            schedule=config.rtc_schedule,
            max_weight=config.rtc_max_weight,
            jacobian=config.rtc_jacobian,
            trained=trained > 0,
        )

    def _noise(self, shape: tuple[int, int]) -> NDArray[np.float32]:
        random = (
            np.random.default_rng(self._config.numpy_seed)
            if self._config.noise == "fixed"
            else self._random
        )
        return random.standard_normal(shape, dtype=np.float32)
