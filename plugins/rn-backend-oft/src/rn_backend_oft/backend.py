"""The backends `oft`, `oft-primary` and `oft-pair`, which map images, state and an instruction to
an action chunk.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from rn_backend_oft.config import OftConfig
from rn_backend_oft.policy import OftPolicy
from rn_backend_oft.state import read_state, state_width
from rn_vla.decoding import (
    BatchRuntime,
    LlamaAcceleration,
    Reply,
    RowsReply,
    RowsRequest,
    RowsRuntime,
)
from rn_vla.joint_rows import PlatformJoints
from rn_vla.openvla.bins import ActionBins, OutsideCounter
from rn_vla.openvla.checkpoint import OpenvlaCheckpoint
from rn_vla.openvla.policy import action_bins, prompt_encoder
from rn_vla.openvla.preprocessing import Preprocessor
from rn_vla.openvla.prompt import PromptEncoder
from rn_vla.openvla.statistics import DatasetStatistics, Scaling, choose_statistics
from roboneuron import (
    ACTION_SIZE,
    EE_DELTA,
    ActionChunk,
    ConfigurationError,
    Observation,
    PluginError,
    StateError,
    UngroundedError,
    UnsafeError,
)

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

_EPSILON = 1e-8
"""Added to every range. Source: OpenVLA-OFT, un-normalisation of actions and normalisation of
proprioception.
"""


class OftBackend:
    """Implements `roboneuron.contract.Backend`."""

    cameras: ClassVar[tuple[str, ...]] = ("primary", "wrist")
    """Roles in the order of the model's images."""

    def __init__(
        self,
        config: OftConfig,
        *,
        runtime: RowsRuntime | None = None,
        acceleration: LlamaAcceleration | None = None,
    ) -> None:
        self._config = config
        self._profile = None if config.profile == "joints" else config.action_profile()
        self._rows: PlatformJoints | None = None
        self._joints = config.joints or ()
        self._space = EE_DELTA
        self._constants = config.platform()
        self._runtime = runtime
        self._acceleration = acceleration
        self._policy: OftPolicy
        self._encoder: PromptEncoder
        self._preprocessor: Preprocessor
        self._scaling: Scaling
        self._proprio: Scaling | None = None
        self._bins: ActionBins
        self._outside: OutsideCounter
        self._visual_tokens = 0
        self._loaded = False

    def load(self) -> None:
        """Read the checkpoint with its component files and pass it to the runtime.

        Raises:
            CheckpointError: files are missing, damaged, of another family or of an unsupported
                kind.
            ConfigurationError: an option does not fit the checkpoint or the contract.
        """
        config, constants = self._config, self._constants
        if self._runtime is None:
            raise ConfigurationError(
                "Backend 'oft' needs a runtime.", hint="Install rn-runtime-torch."
            )
        self._rows = config.joint_rows()
        if self._rows is not None:
            self._space = self._rows.space(self._joints)
        elif constants.action_width != ACTION_SIZE:
            raise ConfigurationError(
                f"constants = {config.constants!r} has {constants.action_width} values per action; "
                f"TCP delta and gripper of one arm are {ACTION_SIZE} values."
            )
        checkpoint = OpenvlaCheckpoint.read(config.checkpoint)
        key, statistics = choose_statistics(
            checkpoint.statistics, config.unnorm_key, checkpoint.statistics_source
        )
        self._read_scalings(key, statistics)
        self._policy = OftPolicy(
            checkpoint=checkpoint,
            constants=constants,
            cameras=len(self.cameras),
            head=config.head,
            proprio_width=self._proprio.width if self._proprio is not None else 0,
        )
        self._encoder = prompt_encoder(checkpoint, "v02")
        self._preprocessor = Preprocessor(
            size=checkpoint.vision.towers[0].image,
            towers=checkpoint.towers,
            steps=config.image_steps,
        )
        self._bins = action_bins(checkpoint)
        self._outside = OutsideCounter(self._bins, config.max_outside_share)
        model = self._policy.model(config.max_prompt_tokens, self._encoder.shortest())
        self._visual_tokens = model.visual_tokens
        self._runtime.load(model, self._acceleration)
        self._loaded = True

    def _read_scalings(self, key: str, statistics: DatasetStatistics) -> None:
        constants = self._constants
        self._scaling = Scaling.of(statistics.action, constants.bounds, _EPSILON)
        if self._scaling.width != constants.action_width:
            raise ConfigurationError(
                f"Data set {key!r} has {self._scaling.width} action values, "
                f"constants = {self._config.constants!r} says {constants.action_width}."
            )
        self._proprio = None
        if not self._config.proprio:
            return
        width = constants.action_width if self._rows else state_width(constants.state)
        if statistics.proprio is None or len(statistics.proprio.min) != width:
            has = "none" if statistics.proprio is None else str(len(statistics.proprio.min))
            raise ConfigurationError(
                f"Data set {key!r} has {has} proprio values, the state layout {constants.state!r} "
                f"gives {width}."
            )
        statistics.proprio.check_order(f"data set {key!r}, proprio,")
        self._proprio = Scaling.of(statistics.proprio, constants.bounds, _EPSILON)

    def predict(self, observation: Observation) -> ActionChunk:
        """Predict a chunk of actions from the newest images and state.

        Raises:
            UngroundedError: a camera or the state is missing from the observation, or too many of
                the decoded tokens are not action tokens (`head = "tokens"`).
            UnsafeError: the model produced non-finite values.
        """
        runtime, started = self._loaded_runtime(), time.perf_counter()
        request = self._request(observation)
        prepared = time.perf_counter()
        return self._chunk(observation, runtime.run(request), started, prepared)

    def predict_batch(self, observations: Sequence[Observation]) -> list[ActionChunk]:
        """Predict a chunk for each observation, in their order, in one pass if the runtime can.

        With the runtime `torch` in float32, each is within 1e-5 of the result of `predict`; times
        are those of the whole batch. A runtime without `run_batch` is called once per observation.

        Raises:
            RoboNeuronError: as `predict`, for all of them.
        """
        if not observations:
            return []
        runtime, started = self._loaded_runtime(), time.perf_counter()
        requests = [self._request(observation) for observation in observations]
        prepared = time.perf_counter()
        if isinstance(runtime, BatchRuntime):
            replies = runtime.run_batch(requests)
        else:
            replies = [runtime.run(request) for request in requests]
        return [
            self._chunk(observation, reply, started, prepared)
            for observation, reply in zip(observations, replies, strict=True)
        ]

    def _loaded_runtime(self) -> RowsRuntime:
        if not self._loaded or self._runtime is None:
            raise StateError("Backend 'oft' is not loaded; call load first.")
        return self._runtime

    def _request(self, observation: Observation) -> RowsRequest:
        images = []
        for role in self.cameras:
            frame = observation.frames.get(role)
            if frame is None:
                raise UngroundedError(
                    f"The observation has no image of role {role!r}, only "
                    f"{sorted(observation.frames)}."
                )
            images.append(self._preprocessor.to_model_image(frame.image))
        text = self._encoder.to_text(observation.instruction)
        return self._policy.request(
            text=text,
            ids=self._encoder.to_ids(text),
            images=tuple(images),
            pixel_values=np.concatenate([self._preprocessor.to_pixels(image) for image in images]),
            proprio=self._normalized_state(observation),
            timeout_s=self._config.timeout_s,
        )

    def _chunk(
        self, observation: Observation, reply: Reply, started: float, prepared: float
    ) -> ActionChunk:
        if not isinstance(reply, RowsReply):
            raise PluginError(f"The runtime answered {type(reply).__name__}, expected RowsReply.")
        normalized, outside, note = self._to_normalized(reply.values)
        actions = self._to_contract(normalized, observation)
        metrics = {
            "preprocess_ms": (prepared - started) * 1e3,
            "inference_ms": (time.perf_counter() - started) * 1e3,
            "visual_tokens": float(self._visual_tokens),
            **outside,
            **reply.metrics,
        }
        played = actions[: self._config.execute]
        told = " ".join(filter(None, (note, reply.note)))
        step_s = self._constants.step_s if self._profile is None else self._profile.step_s
        return ActionChunk(
            actions=played, step_s=step_s, metrics=metrics, note=told, space=self._space
        )

    def _normalized_state(self, observation: Observation) -> F32 | None:
        if self._rows is not None:
            state = self._rows.read_state(observation, self._joints)
        else:
            state = read_state(
                observation,
                self._constants.state,
                finger_travel_m=self._config.finger_travel_m,
                origin_m=np.array(self._config.state_origin_m),
                finger_joints=self._config.finger_joints,
                by_quaternion=self._config.state_rotation == "quaternion",
            )
        return (
            None if self._proprio is None else self._proprio.to_normalized(state).astype(np.float32)
        )

    def _to_normalized(self, values: F32) -> tuple[F64, dict[str, float], str]:
        """Normalised actions (chunk, width), with metrics and a note on the tokens they were
        decoded from.
        """
        shape = (self._constants.chunk, self._constants.action_width)
        if values.size != shape[0] * shape[1]:
            raise PluginError(f"The runtime answered values {values.shape}, expected {shape}.")
        if self._config.head == "l1":
            return values.reshape(shape).astype(np.float64), {}, ""
        if not np.isfinite(values).all():
            raise UnsafeError("The model produced non-finite values; nothing was published.")
        tokens = values.reshape(-1).astype(np.int64)
        outside, note = self._outside.check(tokens)
        return self._bins.to_values(tokens).reshape(shape), outside, note

    def _to_contract(self, normalized: F64, observation: Observation) -> F64:
        native = self._scaling.to_units(normalized)
        if not np.isfinite(native).all():
            raise UnsafeError("The model produced non-finite values; nothing was published.")
        if self._profile is not None:
            return self._profile.to_contract(native, observation.ee_pose)
        if self._rows is None:
            raise StateError("Backend 'oft' is not loaded; call load first.")
        return self._rows.to_contract(native)

    def reset(self) -> None:
        """Nothing to do: the backend keeps no history."""

    def close(self) -> None:
        """Release the runtime's model."""
        self._loaded = False
        if self._runtime is not None:
            self._runtime.close()


class OftPrimaryBackend(OftBackend):
    """Backend for checkpoints trained with one camera."""

    cameras: ClassVar[tuple[str, ...]] = ("primary",)


class OftPairBackend(OftBackend):
    """Backend for checkpoints trained with a primary camera and one at each of two wrists."""

    cameras: ClassVar[tuple[str, ...]] = ("primary", "wrist", "right_wrist")
