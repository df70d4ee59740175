"""The backends `openvla` and `openvla-tcp`, which map an image and an instruction to one action."""

from __future__ import annotations

import time
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from rn_backend_openvla.config import OpenVlaConfig
from rn_vla.decoding import LlamaAcceleration, TokenReply, TokenRuntime
from rn_vla.openvla.bins import ActionBins, OutsideCounter
from rn_vla.openvla.checkpoint import OpenvlaCheckpoint
from rn_vla.openvla.policy import action_bins, policy_model, prompt_encoder, token_request
from rn_vla.openvla.preprocessing import Preprocessor
from rn_vla.openvla.prompt import PromptEncoder
from rn_vla.openvla.statistics import Scaling, choose_statistics
from roboneuron import (
    ACTION_SIZE,
    ActionChunk,
    CheckpointError,
    ConfigurationError,
    Observation,
    PluginError,
    Pose,
    StateError,
    UngroundedError,
    UnsafeError,
)

F64 = NDArray[np.float64]

CAMERA = "primary"
"""Role of the only camera."""


class OpenVlaBackend:
    """Implements `roboneuron.contract.Backend`."""

    frame: ClassVar[str] = "base"
    """Frame of the accepted profiles: without the TCP pose only base-frame actions can be
    converted.
    """

    def __init__(
        self,
        config: OpenVlaConfig,
        *,
        runtime: TokenRuntime | None = None,
        acceleration: LlamaAcceleration | None = None,
    ) -> None:
        self._config = config
        self._profile = config.action_profile()
        self._runtime = runtime
        self._acceleration = acceleration
        self._encoder: PromptEncoder
        self._preprocessor: Preprocessor
        self._scaling: Scaling
        self._bins: ActionBins
        self._outside: OutsideCounter
        self._visual_tokens = 0
        self._loaded = False

    def load(self) -> None:
        """Read the checkpoint and pass it to the runtime.

        Raises:
            CheckpointError: files are missing, damaged or of another family.
            ConfigurationError: an option does not fit the checkpoint.
        """
        config = self._config
        if self._runtime is None:
            raise ConfigurationError(
                "Backend 'openvla' needs a runtime.", hint="Install rn-runtime-torch."
            )
        check_frame(self._profile.frame, self.frame)
        checkpoint = OpenvlaCheckpoint.read(config.checkpoint)
        _check_no_components(checkpoint)
        key, statistics = choose_statistics(
            checkpoint.statistics, config.unnorm_key, checkpoint.statistics_source
        )
        self._scaling = Scaling.of(statistics.action, "q99", 0.0)
        if self._scaling.width != ACTION_SIZE:
            raise ConfigurationError(
                f"Data set {key!r} has {self._scaling.width} action values, a single arm's TCP "
                f"delta has {ACTION_SIZE}."
            )
        template = (
            config.prompt if config.prompt != "auto" else "v01" if checkpoint.is_vicuna else "v02"
        )
        self._encoder = prompt_encoder(checkpoint, template)
        self._preprocessor = Preprocessor(
            size=checkpoint.vision.towers[0].image,
            towers=checkpoint.towers,
            steps=config.image_steps,
        )
        self._bins = action_bins(checkpoint)
        self._outside = OutsideCounter(self._bins, config.max_outside_share)
        model = policy_model(
            checkpoint,
            action_width=ACTION_SIZE,
            max_prompt_tokens=config.max_prompt_tokens,
            min_prompt_tokens=self._encoder.shortest(),
        )
        self._visual_tokens = model.visual_tokens
        self._runtime.load(model, self._acceleration)
        self._loaded = True

    def predict(self, observation: Observation) -> ActionChunk:
        """Predict one action from the newest image.

        Raises:
            UngroundedError: the camera or the pose is missing from the observation, or too many of
                the decoded tokens are not action tokens.
            UnsafeError: the model produced non-finite values.
        """
        if not self._loaded or self._runtime is None:
            raise StateError("Backend 'openvla' is not loaded; call load first.")
        started = time.perf_counter()
        frame = observation.frames.get(CAMERA)
        if frame is None:
            raise UngroundedError(
                f"The observation has no image of role {CAMERA!r}, only "
                f"{sorted(observation.frames)}."
            )
        if self.frame == "tcp":
            check_pose(observation.ee_pose)
        text = self._encoder.to_text(observation.instruction)
        image = self._preprocessor.to_model_image(frame.image)
        request = token_request(
            text=text,
            ids=self._encoder.to_ids(text),
            image=image,
            pixel_values=self._preprocessor.to_pixels(image),
            action_width=ACTION_SIZE,
            timeout_s=self._config.timeout_s,
        )
        prepared = time.perf_counter()
        reply = self._runtime.run(request)
        if not isinstance(reply, TokenReply) or reply.tokens.shape != (ACTION_SIZE,):
            raise PluginError(f"The runtime answered {reply!r}, expected {ACTION_SIZE} tokens.")
        outside, note = self._outside.check(reply.tokens)
        native = self._scaling.to_units(self._bins.to_values(reply.tokens))[None]
        if not np.isfinite(native).all():
            raise UnsafeError("The model produced non-finite values; nothing was published.")
        actions = self._profile.to_contract(native, observation.ee_pose)
        metrics = {
            "preprocess_ms": (prepared - started) * 1e3,
            "inference_ms": (time.perf_counter() - started) * 1e3,
            "visual_tokens": float(self._visual_tokens),
            **outside,
            **reply.metrics,
        }
        told = " ".join(filter(None, (note, reply.note)))
        return ActionChunk(actions=actions, step_s=self._profile.step_s, metrics=metrics, note=told)

    def reset(self) -> None:
        """Nothing to do: the backend keeps no history."""

    def close(self) -> None:
        """Release the runtime's model."""
        self._loaded = False
        if self._runtime is not None:
            self._runtime.close()


class OpenVlaTcpBackend(OpenVlaBackend):
    """Backend for checkpoints whose actions are in the tool frame."""

    frame: ClassVar[str] = "tcp"


def _check_no_components(checkpoint: OpenvlaCheckpoint) -> None:
    """Raise CheckpointError for an OFT checkpoint: it would load as OpenVLA, but its language model
    no longer decodes token by token.
    """
    found = sorted(checkpoint.path.glob("*--*checkpoint.pt"))
    if found:
        raise CheckpointError(
            f"{checkpoint.path} holds {found[0].name}: it is an OpenVLA-OFT checkpoint.",
            hint="Use the backend 'oft'.",
        )


def check_pose(pose: Pose | None) -> None:
    """Raise UngroundedError unless there is a pose with finite values."""
    if pose is None:
        raise UngroundedError("The observation has no TCP pose, which tool-frame actions need.")
    if not (np.isfinite(pose.position_m).all() and np.isfinite(pose.quaternion_xyzw).all()):
        raise UngroundedError(
            "The measured TCP pose holds a non-finite value; the robot is to hold."
        )


def check_frame(profile: str, backend: str) -> None:
    """Raise ConfigurationError if a profile's frame is not the one that the backend converts."""
    if profile != backend:
        raise ConfigurationError(
            f"The profile's actions are in the frame {profile!r}, this backend converts from "
            f"{backend!r}.",
            hint="Backends whose names end in -tcp take tool-frame checkpoints, the others "
            "base-frame ones.",
        )
