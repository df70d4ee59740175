"""Cases: a descriptor, options it can run with, and what the rules of its kind need to try it.

A case is what a contract class's one fixture returns and what a descriptor's `case` function returns. Everything but
`spec` has a default that suffices for a plugin that works with synthetic input.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from rn_testing.deadline import CALL_LIMITS_S, call_bounded
from rn_testing.fakes import MemoryTopics, gantry_profile, make_observation
from rn_testing.rule import NotApplicable, Violation
from roboneuron.contract import (
    Acceleration,
    Backend,
    CameraProfile,
    Controller,
    Observation,
    PerceptionSource,
    RobotDriver,
    RobotProfile,
    Runtime,
)
from roboneuron.plugins.loading import load_options, load_options_model, load_target
from roboneuron.plugins.specs import (
    AccelerationSpec,
    BackendSpec,
    CommandSpec,
    ControllerSpec,
    DriverSpec,
    FeatureSpec,
    PerceptionSpec,
    RobotSpec,
    RuntimeSpec,
    Spec,
)

if TYPE_CHECKING:
    from pydantic import BaseModel

    from roboneuron.cli.commands import CommandModule
    from roboneuron.server.feature import Feature

S = TypeVar("S", bound=Spec)


@dataclass(frozen=True, kw_only=True)
class Case(Generic[S]):
    """What every case has.

    Attributes:
        spec: the descriptor under test.
        options: as a user would set them under `[plugins.<name>]`.
        limits_s: bound on one call by method name [s] ("predict", "close"), over those of
            `rn_testing.deadline`; a call that takes longer fails its rule.
        is_automatic: made without the author's help (`roboneuron plugins check` on a plugin without `case`): then what
            cannot be started for want of options, hardware or weights is skipped with the reason instead of failing.
    """

    subject: ClassVar[str] = ""
    """First half of the ids of the rules that apply."""

    spec: S
    options: Mapping[str, object] = field(default_factory=dict)
    limits_s: Mapping[str, float] = field(default_factory=dict)
    is_automatic: bool = False

    def configuration(self) -> object:
        """The validated options, or None when the descriptor takes none."""
        return load_options(self.spec, self.options)

    def _target(self, spec: Spec | DriverSpec) -> Callable[..., Any]:
        target = load_target(spec)
        if not callable(target):
            raise Violation(f"`target` names {target!r}, expected a class or function")
        return target

    def _bounded(self, construct: Callable[[], Any]) -> Callable[[], Any]:
        limit_s = {**CALL_LIMITS_S, **self.limits_s}["constructor"]
        return lambda: call_bounded("the constructor", limit_s, construct)

    def arguments(self) -> tuple[tuple[object, ...], dict[str, object]]:
        """Positional and keyword arguments that `target` is called with, apart from real values."""
        return (None,), {}

    def inputs(self, topics: MemoryTopics) -> tuple[tuple[object, ...], dict[str, object]]:
        """Real positional arguments after the configuration, and keyword arguments."""
        return (), {}

    def option_names(self) -> frozenset[str]:
        """The options that the case sets, which its plugin therefore is to read."""
        return frozenset(self.options)

    def prepare(
        self, topics: MemoryTopics | None = None, configure: Callable[[object], object] = lambda options: options
    ) -> Callable[[], Any]:
        """Load target and options and make the arguments; what is returned does nothing but call the constructor.

        Args:
            topics: lent to the plugin; new ones when None.
            configure: given the validated options, returns what is passed instead.
        """
        target, configuration = self._target(self.spec), configure(self.configuration())
        positional, named = self.inputs(MemoryTopics() if topics is None else topics)
        return self._bounded(lambda: target(configuration, *positional, **named))


@dataclass(frozen=True, kw_only=True)
class BackendCase(Case[BackendSpec]):
    """A backend to try.

    Attributes:
        observe: makes an observation that the backend can act on; a synthetic one when None. It is cut down to what the
            descriptor declares before use.
        runtime, acceleration: make what the backend is to be built with; None for without.
        predict_limit_s: how long the quickest of three predictions may take [s].
    """

    subject: ClassVar[str] = "backend"

    observe: Callable[[], Observation] | None = None
    runtime: Callable[[], Runtime] | None = None
    acceleration: Callable[[], Acceleration] | None = None
    predict_limit_s: float = 1.0

    def arguments(self) -> tuple[tuple[object, ...], dict[str, object]]:
        """As the inference module calls it."""
        return (None,), {"runtime": None, "acceleration": None}

    def inputs(self, topics: MemoryTopics) -> tuple[tuple[object, ...], dict[str, object]]:
        """A new runtime and a new acceleration, if the case has some."""
        runtime = None if self.runtime is None else self.runtime()
        return (), {"runtime": runtime, "acceleration": None if self.acceleration is None else self.acceleration()}

    def build(self) -> Backend:
        """A new backend, not loaded."""
        return cast(Backend, self.prepare()())

    def observation(self) -> Observation:
        """What the backend sees: required roles only, state only when declared."""
        whole = make_observation(self.spec) if self.observe is None else self.observe()
        frames = {role: frame for role, frame in whole.frames.items() if role in self.spec.cameras}
        if self.spec.needs_state:
            return replace(whole, frames=frames)
        return replace(whole, frames=frames, joints=None, ee_pose=None, gripper_open=None)


@dataclass(frozen=True, kw_only=True)
class RuntimeCase(Case[RuntimeSpec]):
    """A runtime to try; what a model and a request look like is agreed per model family.

    Attributes:
        model: makes what `load` takes; None when there is none to try.
        request: makes what `run` takes; None likewise.
        bad_request: makes a request that must be refused; None likewise.
        acceleration: makes a preset that `load` must accept; None likewise.
        other_request: makes another request than `request`, whose answer differs; None likewise.
        long_request: makes a request that runs for seconds unless it is aborted; `request` when None.
        expected: makes the answer to `request`; None when it is not known.
        run_limit_s: how long the quickest of three runs of `request` may take [s].
    """

    subject: ClassVar[str] = "runtime"

    model: Callable[[], object] | None = None
    request: Callable[[], object] | None = None
    bad_request: Callable[[], object] | None = None
    acceleration: Callable[[], Acceleration] | None = None
    other_request: Callable[[], object] | None = None
    long_request: Callable[[], object] | None = None
    expected: Callable[[], object] | None = None
    run_limit_s: float = 5.0

    def build(self) -> Runtime:
        """A new runtime, not loaded."""
        return cast(Runtime, self.prepare()())


@dataclass(frozen=True, kw_only=True)
class AccelerationCase(Case[AccelerationSpec]):
    """An acceleration to try.

    Attributes:
        decoder: makes a decoder that has the capability; None when there is none to try.
        expected: takes a decoder that the preset was applied to and says whether it was changed as intended; None when
            only a change of any kind can be told.
    """

    subject: ClassVar[str] = "acceleration"

    decoder: Callable[[], object] | None = None
    expected: Callable[[Any], bool] | None = None

    def build(self) -> Acceleration:
        """A new preset."""
        return cast(Acceleration, self.prepare()())


@dataclass(frozen=True, kw_only=True)
class PerceptionCase(Case[PerceptionSpec]):
    """A source of frames to try.

    Attributes:
        cameras: makes the profiles to serve; the fake robot's when None.
        feed: makes a frame arrive, called before each read with the open source and its topics; None when frames come
            by themselves.
        timeout_s: bound on waiting for one frame [s].
        expected: makes the image that the first frame shows, RGB; None when it is not known. The mean difference may
            be 12 of 255, so that a lossy codec passes.
    """

    subject: ClassVar[str] = "perception"

    cameras: Callable[[], tuple[CameraProfile, ...]] | None = None
    feed: Callable[[Any, MemoryTopics], None] | None = None
    timeout_s: float = 10.0
    expected: Callable[[], NDArray[np.uint8]] | None = None

    def arguments(self) -> tuple[tuple[object, ...], dict[str, object]]:
        """As the perception module calls it."""
        return (None, MemoryTopics(), ()), {}

    def profiles(self) -> tuple[CameraProfile, ...]:
        """The cameras to serve."""
        return gantry_profile().cameras if self.cameras is None else self.cameras()

    def inputs(self, topics: MemoryTopics) -> tuple[tuple[object, ...], dict[str, object]]:
        """The topics and the cameras."""
        return (topics, self.profiles()), {}

    def build(self, topics: MemoryTopics) -> PerceptionSource:
        """A new source, not open."""
        return cast(PerceptionSource, self.prepare(topics)())


@dataclass(frozen=True, kw_only=True)
class ControllerCase(Case[ControllerSpec]):
    """A controller to try.

    Attributes:
        profile: makes the profile of an arm to move; the fake robot's when None.
    """

    subject: ClassVar[str] = "controller"

    profile: Callable[[], RobotProfile] | None = None

    def arguments(self) -> tuple[tuple[object, ...], dict[str, object]]:
        """As the control module calls it."""
        return (None, gantry_profile()), {}

    def robot(self) -> RobotProfile:
        """The arm to move."""
        profile = gantry_profile() if self.profile is None else self.profile()
        if "arm" not in self.spec.robot_kinds:
            raise NotApplicable("the controller moves no arms")
        return profile

    def inputs(self, topics: MemoryTopics) -> tuple[tuple[object, ...], dict[str, object]]:
        """The arm's profile."""
        return (self.robot(),), {}

    def build(self) -> Controller:
        """A new controller, not loaded."""
        return cast(Controller, self.prepare()())


@dataclass(frozen=True, kw_only=True)
class RobotCase(Case[RobotSpec]):
    """A robot to try, with one of its drivers.

    Attributes:
        driver: name of the driver that the rules may open and *move*; None to leave all of them alone.
        driver_options: its options.
        step: how far the rules move one joint [rad or m].
        settle_s: bound on the time such a move takes [s].
        tolerance: how near the driver must come [rad or m].
    """

    subject: ClassVar[str] = "robot"

    driver: str | None = "simulated"
    driver_options: Mapping[str, object] = field(default_factory=dict)
    step: float = 0.02
    settle_s: float = 5.0
    tolerance: float = 0.005

    def arguments(self) -> tuple[tuple[object, ...], dict[str, object]]:
        """The profile's function takes none."""
        return (), {}

    def profile(self) -> RobotProfile:
        """What `target` returns."""
        profile = self._target(self.spec)()
        if not isinstance(profile, RobotProfile):
            raise Violation(f"`target` returned {type(profile).__name__}, expected a RobotProfile")
        return profile

    def driver_spec(self) -> DriverSpec:
        """The driver to try; raises NotApplicable when there is none."""
        if self.driver is None:
            raise NotApplicable("no driver may be moved by this case")
        spec = self.spec.driver(self.driver)
        if spec is None and self.is_automatic:
            raise NotApplicable(f"there is no driver {self.driver!r} to try")
        if spec is None:
            raise Violation(f"the case names the driver {self.driver!r}, which the descriptor lacks")
        return spec

    def option_names(self) -> frozenset[str]:
        """The options of the driver that the case sets."""
        return frozenset(self.driver_options)

    def prepare(
        self, topics: MemoryTopics | None = None, configure: Callable[[object], object] = lambda options: options
    ) -> Callable[[], Any]:
        """As of every case, for the driver; the profile is made here, so that its files are not the constructor's."""
        spec = self.driver_spec()
        target, options = self._target(spec), configure(load_options(spec, self.driver_options))
        profile, lent = self.profile(), MemoryTopics() if topics is None else topics
        return self._bounded(lambda: target(options, profile, lent))

    def build(self, topics: MemoryTopics) -> RobotDriver:
        """A new driver, not open."""
        return cast(RobotDriver, self.prepare(topics)())


@dataclass(frozen=True, kw_only=True)
class FeatureCase(Case[FeatureSpec]):
    """A feature to try; `options` are its section of roboneuron.toml, or its sections by key when it has several.

    Attributes:
        needs: descriptors of the features that it needs.
    """

    subject: ClassVar[str] = "feature"

    needs: tuple[FeatureSpec, ...] = ()

    def sections(self) -> dict[str, object]:
        """The sections as they stand in roboneuron.toml."""
        if not self.options:
            return {}
        return dict(self.options) if self.spec.sections else {self.spec.keys[0]: dict(self.options)}

    def options_model(self) -> type[BaseModel] | None:
        """The class of its options."""
        return load_options_model(self.spec)

    def configuration(self) -> object:
        """The validated options, or None when the descriptor takes none."""
        model = self.options_model()
        return None if model is None else model.model_validate(self.options)

    def build(self) -> Feature[Any]:
        """A new feature, not started."""
        return cast("Feature[Any]", self.prepare()())


@dataclass(frozen=True, kw_only=True)
class CommandCase(Case[CommandSpec]):
    """A command to try; it is never run."""

    subject: ClassVar[str] = "command"

    def arguments(self) -> tuple[tuple[object, ...], dict[str, object]]:
        """The class takes none."""
        return (), {}

    def prepare(
        self, topics: MemoryTopics | None = None, configure: Callable[[object], object] = lambda options: options
    ) -> Callable[[], Any]:
        """As of every case; a command is given nothing."""
        return self._bounded(self._target(self.spec))

    def build(self) -> CommandModule:
        """A new command."""
        return cast("CommandModule", self.prepare()())


@dataclass(frozen=True, kw_only=True)
class PackageCase:
    """An installed distribution to examine.

    Attributes:
        distribution: its name.
        path: where its metadata are found; the interpreter's own path when empty.
    """

    subject: ClassVar[str] = "package"

    distribution: str
    path: tuple[str, ...] = ()


CASES: dict[str, type[Case[Any]]] = {
    "backend": BackendCase,
    "runtime": RuntimeCase,
    "acceleration": AccelerationCase,
    "perception": PerceptionCase,
    "controller": ControllerCase,
    "robot": RobotCase,
    "feature": FeatureCase,
    "command": CommandCase,
}
"""Case class by descriptor kind."""
