"""Checkers of joint paths from the configuration: one in front of the driver, and its copies for
early refusals.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import cast

from roboneuron.config import models
from roboneuron.config.models import Config
from roboneuron.contract import Controller, PostureInspector, RobotProfile
from roboneuron.errors import ConfigurationError, RoboNeuronError
from roboneuron.gate.motion.driver_paths import DriverPaths
from roboneuron.gate.motion.path_limits import PathLimiter
from roboneuron.gate.motion.rules import MotionRules, inspector_of, motion_rules, poses_of
from roboneuron.modules.plugin import build, load_profile
from roboneuron.modules.settings import COLLISION_CHECKED, PLACES_CHECKED, PLACES_UNCHECKED
from roboneuron.plugins.registry import Registry
from roboneuron.plugins.specs import ControllerSpec

__all__ = ["UncheckedPaths"]
"""Names that other distributions may use."""

_Key = tuple[str, str]


class ArmPaths:
    """Creates a checker of joint motions per arm on first use; usable from any thread."""

    def __init__(
        self,
        config: Config,
        registry: Callable[[], Registry],
        limits: Callable[[], models.LimitsConfig] | None = None,
    ) -> None:
        """Args:
        config: configuration of the server; other arms than its own get the default limits and
            their profile.
        registry: returns the installed plugins.
        limits: returns the limits in force for the server's own robot; its `[limits]` if None.
        """
        self._config = config
        self._registry = registry
        self._limits_now = limits or (lambda: config.limits)
        self._made: dict[_Key, PathLimiter] = {}
        # held while a checker is made: a second caller waits for it instead of loading another one
        self._lock = threading.Lock()

    def forget(self) -> None:
        """Discard the checkers, because the limits have changed."""
        with self._lock:
            self._made.clear()

    def rules(self, robot: str, profile: RobotProfile) -> MotionRules:
        """Return the limits of an arm. Raises ConfigurationError as `motion_rules`."""
        return motion_rules(self._limits(robot), profile)

    def limiter(self, robot: str, profile: RobotProfile) -> PathLimiter:
        """Return the checker of an arm; imports the controller's libraries the first time.

        Raises:
            ConfigurationError, MissingDependencyError, PluginError: there is no controller for it;
                its joint motions are refused then.
        """
        name = self.controller(robot).name
        with self._lock:
            if (robot, name) not in self._made:
                self._made[robot, name] = self._of(robot, profile, *self.load(robot, profile))
            return self._made[robot, name]

    def load(self, robot: str, profile: RobotProfile) -> tuple[Controller, RobotProfile]:
        """Create a controller of an arm for one user, and the profile with the collisions in force.
        Raises as `limiter`.
        """
        limited = replace(profile, collision=self.rules(robot, profile).collision)
        spec = self.controller(robot)
        controller = cast("Controller", build(spec, self._config.options(spec.name), limited))
        controller.load()
        return controller, limited

    def driver_paths(self, robot: str, profile: RobotProfile) -> DriverPaths:
        """Return the check in front of an arm's driver; distances are checked if the controller
        tells any. Raises as `limiter`.
        """
        controller, limited = self.load(robot, profile)
        if not isinstance(controller, PostureInspector):
            limited = replace(limited, collision=None)
        return DriverPaths(self._of(robot, profile, controller, limited), limited)

    def _of(
        self, robot: str, profile: RobotProfile, controller: Controller, limited: RobotProfile
    ) -> PathLimiter:
        rules = self.rules(robot, profile)
        return PathLimiter(rules, limited, inspector_of(controller), poses_of(controller))

    def _limits(self, robot: str) -> models.LimitsConfig:
        return self._limits_now() if robot == self._config.robot.name else models.LimitsConfig()

    def controller(self, robot: str) -> ControllerSpec:
        """Return the descriptor of what computes the paths of an arm. Raises ConfigurationError."""
        registry = self._registry()
        if self._config.control is not None:
            return registry.get(ControllerSpec, self._config.control.controller)
        names = sorted(registry.specs(ControllerSpec))
        if len(names) != 1:
            raise ConfigurationError(
                f"Nothing can compute where the joints would move {robot!r}: the configuration "
                "names "
                "no controller"
                + (f", installed are {', '.join(names)}." if names else " and none is installed."),
                hint="Install one (rn-controller-urdf) and name it in [control].",
            )
        return registry.get(ControllerSpec, names[0])


class UncheckedPaths:
    """Why places or distances of the configured arm are not checked: the one sentence of every
    surface. Keeps its newest answer, because pages ask several times a second.
    """

    def __init__(self) -> None:
        self._known: tuple[object, str] = None, ""

    def why(
        self,
        config: Config,
        registry: Registry,
        robot: Mapping[str, str] | None = None,
        control: Mapping[str, str] | None = None,
    ) -> str:
        """See `RobotProfile.why_unchecked`; empty if the robot's plugin cannot be used, which is
        reported elsewhere.

        Args:
            config: configuration with the robot that runs now.
            registry: installed plugins.
            robot, control: metrics in the reports of these modules, as far as they run.
        """
        robot, control = robot or {}, control or {}
        are_told = control.get(COLLISION_CHECKED) != "false"
        told = robot.get(PLACES_UNCHECKED, "") if PLACES_CHECKED in robot else None
        key = (config.robot.name, are_told, told)
        if self._known[0] != key:
            self._known = key, _why(config, registry, are_told, told)
        return self._known[1]


def _why(config: Config, registry: Registry, are_told: bool, told: str | None) -> str:
    """As `UncheckedPaths.why`; `told` is what the robot module says of places, None before that."""
    try:
        profile = load_profile(registry, config.robot)
    except RoboNeuronError:
        return ""
    # under another interpreter another controller may be installed
    if told is None and profile.tcp_link and config.robot.python is None:
        try:
            ArmPaths(config, lambda: registry).controller(config.robot.name)
        except RoboNeuronError as error:
            told = str(error)
    return profile.why_unchecked(config.limits, are_told=are_told, places=told or "")
