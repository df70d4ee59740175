"""LeRobot's own loops, as `lerobot-rollout` runs them, on the frames of an observation."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig, RTCAttentionSchedule
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.policies.rtc.configuration_rtc import RTCConfig
from lerobot.rollout.inference.rtc import RTCInferenceEngine
from lerobot.rollout.inference.sync import SyncInferenceEngine
from lerobot.utils.feature_utils import build_dataset_frame
from numpy.typing import NDArray

from roboneuron import Observation

Rows = NDArray[np.float64]
ALL_ROWS = 10_000


def features(names: tuple[str, ...]) -> dict[str, dict[str, Any]]:
    """Features of a data set of that robot."""
    vector = {"dtype": "float32", "shape": (len(names),), "names": list(names)}
    image = {"dtype": "video", "shape": (96, 96, 3), "names": ["height", "width", "channels"]}
    return {
        "observation.state": vector,
        "observation.images.front": image,
        "observation.images.wrist": image,
        "action": vector,
    }


def values(observation: Observation) -> dict[str, Any]:
    """Result of LeRobot's `Robot.get_observation` for this observation."""
    joints = observation.joints
    assert joints is not None
    found: dict[str, Any] = dict(zip(joints.names, joints.position.tolist(), strict=True))
    found["gripper_open"] = observation.gripper_open
    found |= {f"{name}_gripper": arm.gripper_open for name, arm in observation.arms.items()}
    for frame in observation.frames.values():
        found[frame.camera] = frame.image.copy()
    return found


def load(directory: Path) -> tuple[Any, Any, Any]:
    """Policy, pre- and postprocessor, created by LeRobot's factory."""
    config = PreTrainedConfig.from_pretrained(directory)
    config.device = "cpu"
    policy = get_policy_class(config.type).from_pretrained(directory, config=config)
    return (policy, *make_pre_post_processors(config, str(directory)))


class Synchronous:
    """`SyncInferenceEngine`: one action a tick."""

    def __init__(self, directory: Path, names: tuple[str, ...]) -> None:
        policy, before, after = load(directory)
        self._features = features(names)
        self._engine = SyncInferenceEngine(
            policy, before, after, self._features, list(names), "", "cpu", ""
        )
        self._engine.reset()

    def act(self, observation: Observation) -> Rows:
        """The action of a tick, float64 (n,)."""
        self._engine._task = observation.instruction
        frame = build_dataset_frame(self._features, values(observation), prefix="observation")
        action = self._engine.get_action(frame)
        assert action is not None
        return action.numpy().astype(np.float64)


@dataclass
class Call:
    """Input of LeRobot's policy in one call, and its output.

    Attributes:
        random: state of the random generator at the call.
        delay: `inference_delay`.
        left: `prev_chunk_left_over`, float32 (N, n).
        normalized: answer of the policy, float32 (T, n).
        rows: answer of the postprocessor, float64 (T, n).
    """

    random: torch.Tensor
    delay: int
    left: torch.Tensor | None
    normalized: torch.Tensor
    rows: Rows = field(default_factory=lambda: np.empty((0, 0)))


class FakeRobot:
    """The robot's interface used by the engine."""

    robot_type = ""

    def __init__(self, names: tuple[str, ...]) -> None:
        self.action_features = dict.fromkeys(names, float)


class RealTime:
    """`RTCInferenceEngine`, whose calls of the policy are recorded.

    Args:
        horizon: `execution_horizon`.
        wrap: changes the policy before the engine gets it.
    """

    def __init__(
        self,
        directory: Path,
        names: tuple[str, ...],
        *,
        fps: float,
        horizon: int,
        wrap: Callable[[Any], None] = lambda policy: None,
    ) -> None:
        policy, before, after = load(directory)
        config = RTCConfig(
            enabled=True,
            execution_horizon=horizon,
            prefix_attention_schedule=RTCAttentionSchedule.LINEAR,
        )
        policy.config.rtc_config = config
        policy.init_rtc_processor()
        wrap(policy)
        self.calls: list[Call] = []
        self._watch(policy)
        self.engine = RTCInferenceEngine(
            policy,
            before,
            self._noted(after),
            FakeRobot(names),
            config,
            features(names),
            "pick up the red cube",
            fps,
            "cpu",
            rtc_queue_threshold=0,
        )

    def _watch(self, policy: Any) -> None:
        ask = policy.predict_action_chunk

        def predict_action_chunk(
            batch: Any, *, inference_delay: int = 0, prev_chunk_left_over: Any = None
        ) -> Any:
            random = torch.get_rng_state()
            answer = ask(
                batch, inference_delay=inference_delay, prev_chunk_left_over=prev_chunk_left_over
            )
            self.calls.append(
                Call(random, inference_delay, prev_chunk_left_over, answer[0].clone())
            )
            return answer

        policy.predict_action_chunk = predict_action_chunk

    def _noted(self, after: Any) -> Any:
        calls = self.calls

        class Noted:
            steps = after.steps
            reset = after.reset

            def __call__(self, actions: Any) -> Any:
                rows = after(actions)
                calls[-1].rows = rows[0].numpy().astype(np.float64)
                return rows

        return Noted()

    def __enter__(self) -> RealTime:
        self.engine.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.engine.stop()

    def see(self, observation: Observation) -> None:
        """Pass a new observation; the engine runs from now on."""
        self.engine.notify_observation(values(observation))
        self.engine.resume()

    def continue_on(self, observation: Observation) -> None:
        """Pass a new observation, which the engine answers although rows are left."""
        self.engine.pause()
        self.engine._rtc_queue_threshold = ALL_ROWS
        self.see(observation)

    def wait_for_calls(self, count: int, limit_s: float = 60.0) -> None:
        """Wait until `count` chunks are in the queue."""
        end_s = time.monotonic() + limit_s
        while time.monotonic() < end_s:
            queue = self.engine.action_queue
            done = len(self.calls) >= count and len(self.calls[count - 1].rows)
            if done and queue is not None and queue.qsize():
                return
            time.sleep(0.005)
        raise TimeoutError(f"{len(self.calls)} of {count} chunks came")
