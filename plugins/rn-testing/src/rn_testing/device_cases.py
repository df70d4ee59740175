"""Cases of perception sources, controllers and robots."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar, cast

import numpy as np
from numpy.typing import NDArray

from rn_testing.case import Case
from rn_testing.fakes import MemoryTopics, gantry_profile
from rn_testing.rule import NotApplicable, Violation
from roboneuron import (
    CameraProfile,
    Controller,
    ControllerSpec,
    DriverSpec,
    PerceptionSource,
    PerceptionSpec,
    RobotDriver,
    RobotProfile,
    RobotSpec,
)
from roboneuron.command import loading

if TYPE_CHECKING:
    from pydantic import BaseModel


@dataclass(frozen=True, kw_only=True)
class PerceptionCase(Case[PerceptionSpec]):
    """A source of frames to try.

    Attributes:
        cameras: makes the profiles to serve; the fake robot's when None.
        feed: makes a frame arrive, called before each read with the open source and its topics;
            None when frames come by themselves.
        timeout_s: bound on waiting for one frame [s].
        expected: makes the image that the first frame shows, RGB; None when it is not known. The
            mean difference may be 12 of 255, so that a lossy codec passes.
        rate_hz: frames per second of each camera; when None that of the option that says so.
    """

    subject: ClassVar[str] = "perception"

    cameras: Callable[[], tuple[CameraProfile, ...]] | None = None
    feed: Callable[[object, MemoryTopics], None] | None = None
    timeout_s: float = 10.0
    expected: Callable[[], NDArray[np.uint8]] | None = None
    rate_hz: float | None = None

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
        driver: name of the driver that the rules may open and *move*; None to leave all of them
            alone.
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
            raise Violation(
                f"the case names the driver {self.driver!r}, which the descriptor lacks"
            )
        return spec

    def option_names(self) -> frozenset[str]:
        """The options of the driver that the case sets."""
        return frozenset(self.driver_options)

    def given_options(self) -> tuple[str, Mapping[str, object]]:
        """Those of the driver."""
        return "driver_options", self.driver_options

    def option_model(self) -> type[BaseModel] | None:
        """The class of the driver's options."""
        return loading.load_options_model(self.driver_spec())

    def with_options(self, changes: Mapping[str, object]) -> RobotCase:
        """The case with other values of some options of the driver."""
        return replace(self, driver_options={**self.driver_options, **changes})

    def prepare(
        self,
        topics: MemoryTopics | None = None,
        configure: Callable[[object], object] = lambda options: options,
    ) -> Callable[[], Any]:
        """As of every case, for the driver; the profile is made here, so that its files are not the
        constructor's.
        """
        spec = self.driver_spec()
        target, options = (
            self._target(spec),
            configure(loading.load_options(spec, self.driver_options)),
        )
        profile, lent = self.profile(), MemoryTopics() if topics is None else topics
        return self._bounded(lambda: target(options, profile, lent))

    def build(self, topics: MemoryTopics) -> RobotDriver:
        """A new driver, not open."""
        return cast(RobotDriver, self.prepare(topics)())
