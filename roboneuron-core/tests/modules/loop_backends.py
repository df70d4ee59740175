"""The backends of loop_plugin.py, most of them with a fault, and a runtime."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from typing import Any

import loop_plugin
import numpy as np

from roboneuron.contract import (
    ActionChunk,
    ControlSpace,
    Observation,
    RobotProfile,
    robot_space,
)
from roboneuron.errors import CheckpointError, NotReadyError, UngroundedError


class Instant:
    def __init__(self, config: None, runtime: Any = None, acceleration: Any = None) -> None:
        self.resets = 0

    def load(self) -> None: ...

    def predict(self, observation: Observation) -> ActionChunk:
        return ActionChunk(
            actions=np.array([[0.01, 0, 0, 0, 0, 0, 1.0]]),
            step_s=0.02,
            metrics={"tokens_kept": 3.0},
        )

    def reset(self) -> None:
        self.resets += 1

    def close(self) -> None: ...


class Broken(Instant):
    def load(self) -> None:
        raise CheckpointError("The checkpoint is cut short.", hint="Copy it again.")


class Picky(Instant):
    def predict(self, observation: Observation) -> ActionChunk:
        if "red" not in observation.instruction:
            raise UngroundedError(f"Nothing here is called {observation.instruction!r}.")
        assert observation.ee_pose is not None
        assert observation.joints is not None
        return super().predict(observation)


class Slow(Instant):
    def predict(self, observation: Observation) -> ActionChunk:
        time.sleep(0.3)
        return super().predict(observation)


class Moody(Instant):
    """Answers when permitted, with half the speed of `Instant`; fails if the instruction is "fail".

    Attributes:
        asked: set while it is asked.
    """

    may_answer, asked = threading.Event(), threading.Event()

    def predict(self, observation: Observation) -> ActionChunk:
        self.asked.set()
        self.may_answer.wait(30.0)
        self.asked.clear()
        if observation.instruction == "fail":
            raise UngroundedError("It fails.")
        return ActionChunk(actions=np.array([[0.005, 0, 0, 0, 0, 0, 1.0]]), step_s=0.02)


class NaN(Instant):
    def predict(self, observation: Observation) -> ActionChunk:
        return ActionChunk(actions=np.full((1, 7), np.nan), step_s=0.02)


def declared(options: Mapping[str, Any], profile: RobotProfile) -> ControlSpace:
    """The space named by the option `kind`."""
    kind = options.get("kind", "joint_velocity")
    if kind == "number":
        return 5  # type: ignore[return-value]
    return robot_space(kind, profile, 50.0)


class Fickle(Instant):
    """Answers with velocities until the instruction is "another"."""

    def __init__(self, config: None, runtime: Any = None, acceleration: Any = None) -> None:
        super().__init__(config)
        self.space = declared({}, loop_plugin.profile())

    def predict(self, observation: Observation) -> ActionChunk:
        if observation.instruction == "another":
            return super().predict(observation)
        return ActionChunk(actions=np.array([[0.1, -0.1]]), step_s=0.02, space=self.space)


def positions(options: Mapping[str, Any], profile: RobotProfile) -> ControlSpace:
    return robot_space("joint_position", profile, 20.0)


class Planner(Instant):
    """Answers with six positions of a steady motion."""

    def predict(self, observation: Observation) -> ActionChunk:
        actions = np.zeros((6, 2))
        actions[:, 0] = np.arange(1, 7) / 1000
        return ActionChunk(actions=actions, step_s=0.05, space=positions({}, loop_plugin.profile()))


class Chunked(Instant):
    def predict(self, observation: Observation) -> ActionChunk:
        actions = np.zeros((5, 7))
        actions[:, 0] = np.arange(5) / 1000
        return ActionChunk(actions=actions, step_s=0.05)


class Patient:
    """A runtime whose requests take a minute unless aborted."""

    def __init__(self, config: None) -> None:
        self.running = False
        self._aborted = threading.Event()

    def load(self, model: Any, acceleration: Any = None) -> None: ...

    def run(self, request: Any) -> Any:
        self._aborted.clear()
        self.running = True
        given_up = self._aborted.wait(60.0)
        self.running = False
        if given_up:
            raise NotReadyError("The request was given up.")

    def abort(self) -> None:
        self._aborted.set()

    def close(self) -> None: ...


class Served(Instant):
    def __init__(self, config: None, runtime: Patient, acceleration: Any = None) -> None:
        super().__init__(config)
        self.runtime = runtime

    def predict(self, observation: Observation) -> ActionChunk:
        self.runtime.run("what to do")
        return super().predict(observation)
