"""Interface of a suite: protocols and data types."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from roboneuron import (
    EE_DELTA,
    CameraProfile,
    Controller,
    ControlSpace,
    Observation,
    RobotProfile,
)
from roboneuron.feature import Config

F64 = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True)
class Episode:
    """One episode, fully determined by its values and the suite's options.

    Attributes:
        task: name of the task, for the breakdown.
        seed: seed of all its random numbers.
        instruction: the policy's instruction.
        time_limit_s: it fails if it is not done by then [simulated s].
    """

    task: str
    seed: int
    instruction: str
    time_limit_s: float


@dataclass(frozen=True, kw_only=True, slots=True)
class Setup:
    """Setup with which a suite opens its scenes.

    Attributes:
        profile: profile of the suite's robot, with the configured collision model.
        cameras: cameras by the backend's role.
        controller: a loaded controller, from actions to joint commands. None if the suite's
            simulator has its own.
        config: limits, timeouts and options with which the robot would run.
        needs_state: the backend reads joints, TCP pose and gripper.
        space: action space of the rows for `Scene.act`.
    """

    profile: RobotProfile
    cameras: Mapping[str, CameraProfile]
    controller: Controller | None
    config: Config
    needs_state: bool
    space: ControlSpace = EE_DELTA


@dataclass(frozen=True, kw_only=True, slots=True)
class Judgement:
    """Current judgement of an episode, from the simulator's ground truth.

    Attributes:
        success: the task is done.
        is_over: the episode is decided, even before its time limit.
        reason: one sentence for a failure.
        facts: facts for the ledger and the report; "right_object" (1.0 or 0.0) is averaged over the
            episodes that have it.
    """

    success: bool
    is_over: bool
    reason: str = ""
    facts: Mapping[str, str | float] = field(default_factory=dict)


class Scene(Protocol):
    """An open episode. Used from one thread; the same calls yield the same scene, bit for bit.

    Attributes:
        tick_s: resolution of the clock [simulated s]; `advance` takes whole ticks.
        camera_ticks: number of ticks between two images.
        judge_ticks: number of ticks between two calls of `judge`.
    """

    tick_s: float
    camera_ticks: int
    judge_ticks: int

    def observe(self, stamp_ns: int) -> Observation:
        """Current images and state with this stamp, and the instruction."""
        ...

    def act(self, vector: F64, now_s: float) -> str:
        """Execute one row of `Setup.space`, float64 (7,) by default, in contract units; returns ""
        or a word for the effect of the limits.
        """
        ...

    def watch(self, now_s: float) -> None:
        """Called every 0.1 s: stop the robot if actions have stopped coming."""
        ...

    def advance(self, ticks: int) -> None:
        """Advance simulated time."""
        ...

    def judge(self) -> Judgement:
        """Judge the current state."""
        ...

    def state(self) -> bytes:
        """State of the simulator, for the digest of the episode."""
        ...

    def close(self) -> None:
        """Release everything; may be called twice."""
        ...


class Suite(Protocol):
    """Tasks in one simulated world. Built as `target(config)`; used from one thread."""

    def episodes(self, count: int, first_seed: int) -> Sequence[Episode]:
        """The episodes of a run, in the most efficient order; a larger run contains those of a
        smaller one.
        """
        ...

    def open(self, episode: Episode, setup: Setup) -> Scene:
        """Build the scene of one episode."""
        ...

    def close(self) -> None:
        """Release what is held between episodes; may be called twice."""
        ...
