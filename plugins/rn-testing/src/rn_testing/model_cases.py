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
    """A backend to try.

    Attributes:
        observe: makes an observation that the backend can act on; a synthetic one when None. It is
            cut down to what the descriptor declares before use.
        runtime, acceleration: make what the backend is to be built with; None for without.
        predict_limit_s: how long the quickest of three predictions may take [s].
        row_tolerance: how far a backend that declares `conditions_on_rows` may leave the committed
            rows [m, rad, opening]; less than without conditioning. Required of such a backend.
        observe_next: makes what is seen after that, for rules about rows that are played meanwhile;
            with negative pictures and another instruction when None.
        rows: how many actions a chunk has; when None those of the option that says so, or of the
            descriptor.
        robot: makes the profile that `space` is asked with; the fake robot's when None.
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
        """The arm to move."""
        return gantry_profile() if self.robot is None else self.robot()

    def arguments(self) -> tuple[tuple[object, ...], dict[str, object]]:
        """As the inference module calls it."""
        return (None,), {"runtime": None, "acceleration": None}

    def inputs(self, topics: MemoryTopics) -> tuple[tuple[object, ...], dict[str, object]]:
        """A new runtime and a new acceleration, if the case has some."""
        runtime = None if self.runtime is None else self.runtime()
        return (), {
            "runtime": runtime,
            "acceleration": None if self.acceleration is None else self.acceleration(),
        }

    def build(self) -> Backend:
        """A new backend, not loaded."""
        return cast(Backend, self.prepare()())

    def observation(self) -> Observation:
        """What the backend sees: required roles only, state only when declared."""
        return self._declared(
            make_observation(self.spec) if self.observe is None else self.observe()
        )

    def next_observation(self) -> Observation:
        """Something else, to which the backend answers something else; likewise."""
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
    """A runtime to try; what a model and a request look like is agreed per model family.

    Attributes:
        model: makes what `load` takes; None when there is none to try.
        request: makes what `run` takes; None likewise.
        bad_request: makes a request that must be refused; None likewise.
        acceleration: makes a preset that `load` must accept; None likewise.
        other_request: makes another request than `request`, whose answer differs; None likewise.
        late_request: makes a request whose deadline is over; None likewise.
        check_answer: takes model, request and answer and raises Violation for an answer that its
            family does not allow; None likewise.
        long_request: makes a request that runs for seconds unless it is aborted; `request` when
            None.
        expected: makes the answer to `request`; None when it is not known.
        run_limit_s: how long the quickest of three runs of `request` may take [s].
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
    """An acceleration to try.

    Attributes:
        decoder: makes a decoder that has the capability; None when there is none to try.
        expected: takes a decoder that the preset was applied to and says whether it was changed as
            intended; None when only a change of any kind can be told.
    """

    subject: ClassVar[str] = "acceleration"

    decoder: Callable[[], object] | None = None
    expected: Callable[[object], bool] | None = None

    def build(self) -> Acceleration[Any]:
        """A new preset."""
        return cast("Acceleration[Any]", self.prepare()())
