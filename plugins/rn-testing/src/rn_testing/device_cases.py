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
from roboneuron.feature import loading

if TYPE_CHECKING:
    from pydantic import BaseModel


@dataclass(frozen=True, kw_only=True)
class PerceptionCase(Case[PerceptionSpec]):
    """A perception source under test.

    Attributes:
        cameras: creates the camera profiles; those of the fake robot if None.
        feed: makes a frame arrive, called before each read with the open source and its topics;
            None if frames arrive by themselves.
        timeout_s: limit for waiting for one frame [s].
        expected: creates the image of the first frame, RGB; None if it is not known. The mean
            difference may be 12 of 255, so that a lossy codec passes.
        rate_hz: frames per second of each camera; if None, from the option for it.
    """

    subject: ClassVar[str] = "perception"

    cameras: Callable[[], tuple[CameraProfile, ...]] | None = None
    feed: Callable[[object, MemoryTopics], None] | None = None
    timeout_s: float = 10.0
    expected: Callable[[], NDArray[np.uint8]] | None = None
    rate_hz: float | None = None

    def arguments(self) -> tuple[tuple[object, ...], dict[str, object]]:
        """Arguments with which the perception module calls it."""
        return (None, MemoryTopics(), ()), {}

    def profiles(self) -> tuple[CameraProfile, ...]:
        """The cameras of the source."""
        return gantry_profile().cameras if self.cameras is None else self.cameras()

    def inputs(self, topics: MemoryTopics) -> tuple[tuple[object, ...], dict[str, object]]:
        """The topics and the cameras."""
        return (topics, self.profiles()), {}

    def build(self, topics: MemoryTopics) -> PerceptionSource:
        """A new source, not open."""
        return cast(PerceptionSource, self.prepare(topics)())


@dataclass(frozen=True, kw_only=True)
class ControllerCase(Case[ControllerSpec]):
    """A controller under test.

    Attributes:
        profile: creates the profile of the arm; that of the fake robot if None.
    """

    subject: ClassVar[str] = "controller"

    profile: Callable[[], RobotProfile] | None = None

    def arguments(self) -> tuple[tuple[object, ...], dict[str, object]]:
        """Arguments with which the control module calls it."""
        return (None, gantry_profile()), {}

    def robot(self) -> RobotProfile:
        """Profile of the arm."""
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
    """A robot under test, with one of its drivers.

    Attributes:
        driver: name of the driver that the rules may open and *move*; None to leave all drivers
            alone.
        driver_options: options of the driver.
        step: displacement of one joint in the rules [rad or m].
        settle_s: limit for the duration of such a move [s].
        tolerance: position tolerance at the end of a move [rad or m].
    """

    subject: ClassVar[str] = "robot"

    driver: str | None = "simulated"
    driver_options: Mapping[str, object] = field(default_factory=dict)
    step: float = 0.02
    settle_s: float = 5.0
    tolerance: float = 0.005

    def arguments(self) -> tuple[tuple[object, ...], dict[str, object]]:
        """No arguments, as for the profile's function."""
        return (), {}

    def profile(self) -> RobotProfile:
        """Profile returned by `target`."""
        profile = self._target(self.spec)()
        if not isinstance(profile, RobotProfile):
            raise Violation(f"`target` returned {type(profile).__name__}, expected a RobotProfile")
        return profile

    def driver_spec(self) -> DriverSpec:
        """The driver under test. Raises NotApplicable if there is none."""
        if self.driver is None:
            raise NotApplicable("this case permits no driver to move")
        spec = self.spec.driver(self.driver)
        if spec is None and self.is_automatic:
            raise NotApplicable(f"there is no driver {self.driver!r} to try")
        if spec is None:
            raise Violation(
                f"the case names the driver {self.driver!r}, which the descriptor lacks"
            )
        return spec

    def option_names(self) -> frozenset[str]:
        """Options of the driver set by the case."""
        return frozenset(self.driver_options)

    def given_options(self) -> tuple[str, Mapping[str, object]]:
        """Options of the driver."""
        return "driver_options", self.driver_options

    def option_model(self) -> type[BaseModel] | None:
        """The class of the driver's options."""
        return loading.load_options_model(self.driver_spec())

    def with_options(self, changes: Mapping[str, object]) -> RobotCase:
        """Return the case with some driver options changed."""
        return replace(self, driver_options={**self.driver_options, **changes})

    def prepare(
        self,
        topics: MemoryTopics | None = None,
        configure: Callable[[object], object] = lambda options: options,
    ) -> Callable[[], Any]:
        """As in the base class, for the driver; the profile is built here, so that files it opens
        are not attributed to the constructor.
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
