"""Cases of backends, runtimes and accelerations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar, cast

from rn_testing.case import Case
from rn_testing.fakes import MemoryTopics, gantry_profile, make_observation
from roboneuron import (
    Acceleration,
    AccelerationSpec,
    AnyAcceleration,
    AnyRuntime,
    Backend,
    BackendSpec,
    Observation,
    RobotProfile,
    Runtime,
    RuntimeSpec,
)


@dataclass(frozen=True, kw_only=True)
class BackendCase(Case[BackendSpec]):
    """A backend under test.

    Attributes:
        observe: creates an observation that the backend can act on; a synthetic one if None. It is
            reduced to the declared inputs before use.
        runtime, acceleration: create the runtime and acceleration of the backend; None for none.
        predict_limit_s: maximum duration of the quickest of three predictions [s].
        row_tolerance: maximum deviation from the committed rows for a backend that declares
            `conditions_on_rows` [m, rad, opening]; less than without conditioning. Required of such
            a backend.
        observe_next: creates the next observation, for rules about rows executed meanwhile; if
            None, negative images and another instruction.
        rows: number of actions in a chunk; if None, from the option for it or the descriptor.
        robot: creates the profile for `space`; that of the fake robot if None.
    """

    subject: ClassVar[str] = "backend"

    observe: Callable[[], Observation] | None = None
    runtime: Callable[[], AnyRuntime] | None = None
    acceleration: Callable[[], AnyAcceleration] | None = None
    predict_limit_s: float = 1.0
    row_tolerance: float | None = None
    observe_next: Callable[[], Observation] | None = None
    rows: int | None = None
    robot: Callable[[], RobotProfile] | None = None

    def robot_profile(self) -> RobotProfile:
        """Profile of the arm."""
        return gantry_profile() if self.robot is None else self.robot()

    def arguments(self) -> tuple[tuple[object, ...], dict[str, object]]:
        """Arguments with which the inference module calls it."""
        return (None,), {"runtime": None, "acceleration": None}

    def inputs(self, topics: MemoryTopics) -> tuple[tuple[object, ...], dict[str, object]]:
        """A new runtime and a new acceleration, if the case has them."""
        runtime = None if self.runtime is None else self.runtime()
        return (), {
            "runtime": runtime,
            "acceleration": None if self.acceleration is None else self.acceleration(),
        }

    def build(self) -> Backend:
        """A new backend, not loaded."""
        return cast(Backend, self.prepare()())

    def observation(self) -> Observation:
        """The observation for the backend: required roles only, state only if declared."""
        return self._declared(
            make_observation(self.spec) if self.observe is None else self.observe()
        )

    def next_observation(self) -> Observation:
        """A different observation, which leads to a different answer; with the same reduction."""
        if self.observe_next is not None:
            return self._declared(self.observe_next())
        now = self.observation()
        frames = {
            role: replace(frame, image=255 - frame.image) for role, frame in now.frames.items()
        }
        return replace(now, frames=frames, instruction="put it down")

    def _declared(self, whole: Observation) -> Observation:
        frames = {role: frame for role, frame in whole.frames.items() if role in self.spec.cameras}
        if self.spec.needs_state:
            return replace(whole, frames=frames)
        return replace(whole, frames=frames, joints=None, ee_pose=None, gripper_open=None, arms={})


@dataclass(frozen=True, kw_only=True)
class RuntimeCase(Case[RuntimeSpec]):
    """A runtime under test; the format of models and requests is defined per model family.

    Attributes:
        model: creates the argument of `load`; None if there is none.
        request: creates the argument of `run`; None if there is none.
        bad_request: creates a request that must be refused; None if there is none.
        acceleration: creates a preset that `load` must accept; None if there is none.
        other_request: creates a request with another answer than `request`; None if there is none.
        late_request: creates a request whose deadline is over; None if there is none.
        check_answer: checks an answer, given model, request and answer; raises Violation if its
            family does not allow it. None for no check.
        long_request: creates a request that runs for seconds unless it is aborted; `request` if
            None.
        expected: creates the answer to `request`; None if it is not known.
        run_limit_s: maximum duration of the quickest of three runs of `request` [s].
    """

    subject: ClassVar[str] = "runtime"

    model: Callable[[], object] | None = None
    request: Callable[[], object] | None = None
    bad_request: Callable[[], object] | None = None
    acceleration: Callable[[], Acceleration[Any]] | None = None
    other_request: Callable[[], object] | None = None
    late_request: Callable[[], object] | None = None
    check_answer: Callable[[Any, Any, Any], None] | None = None
    long_request: Callable[[], object] | None = None
    expected: Callable[[], object] | None = None
    run_limit_s: float = 5.0

    def build(self) -> Runtime[Any, Any, Any, Any]:
        """A new runtime, not loaded."""
        return cast("Runtime[Any, Any, Any, Any]", self.prepare()())


@dataclass(frozen=True, kw_only=True)
class AccelerationCase(Case[AccelerationSpec]):
    """An acceleration under test.

    Attributes:
        decoder: creates a decoder with the capability; None if there is none.
        expected: checks whether a decoder with the preset was changed as intended; None to accept
            any change.
    """

    subject: ClassVar[str] = "acceleration"

    decoder: Callable[[], object] | None = None
    expected: Callable[[object], bool] | None = None

    def build(self) -> Acceleration[Any]:
        """A new preset."""
        return cast("Acceleration[Any]", self.prepare()())
