"""What a suite of tasks is: protocols and the values that travel."""

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
from roboneuron.command import Config

F64 = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True)
class Episode:
    """One episode, wholly determined by its values and the suite's options.

    Attributes:
        task: name of the task, for the breakdown.
        seed: of everything random in it.
        instruction: what the policy is told.
        time_limit_s: it fails when it is not done by then [simulated s].
    """

    task: str
    seed: int
    instruction: str
    time_limit_s: float


@dataclass(frozen=True, kw_only=True, slots=True)
class Setup:
    """What a suite opens its scenes with.

    Attributes:
        profile: of the suite's robot, with the configured collision model.
        cameras: cameras by the backend's role.
        controller: loaded; from actions to joint commands. None when the suite's simulator has its
            own.
        config: limits, timeouts and options as the robot would be run with.
        needs_state: the backend reads joints, TCP pose and gripper.
        space: of the rows that `Scene.act` gets.
    """

    profile: RobotProfile
    cameras: Mapping[str, CameraProfile]
    controller: Controller | None
    config: Config
    needs_state: bool
    space: ControlSpace = EE_DELTA


@dataclass(frozen=True, kw_only=True, slots=True)
class Judgement:
    """How an episode stands, by the simulator's truth.

    Attributes:
        success: the task is done.
        is_over: it is decided, also before the time is up.
        reason: one sentence for a failure.
        facts: for the ledger and the report; "right_object" (1.0 or 0.0) is averaged over the
            episodes that have it.
    """

    success: bool
    is_over: bool
    reason: str = ""
    facts: Mapping[str, str | float] = field(default_factory=dict)


class Scene(Protocol):
    """An open episode. Used from one thread; the same calls give the same scene, bit for bit.

    Attributes:
        tick_s: the clock's resolution [simulated s]; `advance` takes whole ticks.
        camera_ticks: a new image is taken every so many ticks.
        judge_ticks: `judge` is asked every so many ticks.
    """

    tick_s: float
    camera_ticks: int
    judge_ticks: int

    def observe(self, stamp_ns: int) -> Observation:
        """Images and state of this moment, stamped so, with the instruction."""
        ...

    def act(self, vector: F64, now_s: float) -> str:
        """Execute one row of `Setup.space`, float64 (7,) by default, in contract units; returns ""
        or a word for what the limits did to it.
        """
        ...

    def watch(self, now_s: float) -> None:
        """Called every 0.1 s: what the robot does when actions cease."""
        ...

    def advance(self, ticks: int) -> None:
        """Let time pass."""
        ...

    def judge(self) -> Judgement:
        """How it stands now."""
        ...

    def state(self) -> bytes:
        """The simulator's state, for the digest of the episode."""
        ...

    def close(self) -> None:
        """Release everything; may be called twice."""
        ...


class Suite(Protocol):
    """Tasks in one simulated world. Built as `target(config)`; used from one thread."""

    def episodes(self, count: int, first_seed: int) -> Sequence[Episode]:
        """The episodes of a run, in the order in which they run best; more of them contain the same
        ones.
        """
        ...

    def open(self, episode: Episode, setup: Setup) -> Scene:
        """Build the scene of one episode."""
        ...

    def close(self) -> None:
        """Release what is kept between episodes; may be called twice."""
        ...
