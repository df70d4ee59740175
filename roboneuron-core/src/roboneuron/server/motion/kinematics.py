"""Kinematics for the gate: the controller that control would use, in this process, looks at where joints would go."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from typing import cast

from roboneuron.config import Config, LimitsConfig
from roboneuron.contract import Controller, JointSample, Posture, PostureInspector, RobotProfile
from roboneuron.errors import ConfigurationError
from roboneuron.gate.motion import MotionLimiter, MotionRules, PathLimiter, PredictedArm, collision_of, motion_rules
from roboneuron.modules.plugin import build
from roboneuron.plugins.registry import Registry

_Key = tuple[str, str]


class ArmPaths:
    """Makes a judge of joint motions per arm when the first one comes; usable from any thread."""

    def __init__(self, config: Config, registry: Callable[[], Registry]) -> None:
        """Args:
        config: of the server; its `[limits]` hold for its own robot, other arms have the defaults and their profile.
        registry: the plugins that are installed now.
        """
        self._config = config
        self._registry = registry
        self._made: dict[_Key, PathLimiter] = {}
        self._lock = threading.Lock()

    def rules(self, robot: str, profile: RobotProfile) -> MotionRules:
        """The limits of an arm. Raises ConfigurationError as `motion_rules`."""
        return motion_rules(self._limits(robot), profile)

    def limiter(self, robot: str, profile: RobotProfile) -> PathLimiter:
        """The judge of an arm; imports the controller's libraries the first time.

        Raises:
            ConfigurationError, MissingDependencyError, PluginError: there is no controller for it; its joint motions
                are refused then.
        """
        name = self._controller(robot)
        with self._lock:
            if (robot, name) not in self._made:
                self._made[robot, name] = self._make(robot, name, profile)
            return self._made[robot, name]

    def predicted(self, robot: str, profile: RobotProfile, joints: JointSample) -> PredictedArm:
        """An arm at `joints` that follows actions as control would make it. Raises as `limiter`."""
        controller, inspect, limited = self._load(robot, self._controller(robot), profile)
        control = self._config.control
        limiter = MotionLimiter(
            self.rules(robot, profile),
            limited,
            controller.forward,
            inspect,
            immediate=control is not None and control.command == "joint_state",
            longest_s=self._config.robot.server_timeout_s,
        )
        return PredictedArm(controller, limiter, joints)

    def _make(self, robot: str, name: str, profile: RobotProfile) -> PathLimiter:
        _, inspect, limited = self._load(robot, name, profile)
        return PathLimiter(self.rules(robot, profile), limited, inspect)

    def _load(
        self, robot: str, name: str, profile: RobotProfile
    ) -> tuple[Controller, Callable[[JointSample], Posture], RobotProfile]:
        """A controller of its own, what tells it of postures, and the profile with the collisions in force."""
        limited = replace(profile, collision=collision_of(self._limits(robot), profile))
        spec = self._registry().get("controller", name)
        controller = cast("Controller", build(spec, self._config.options(name), limited))
        controller.load()
        if isinstance(controller, PostureInspector):
            return controller, controller.inspect, limited
        return controller, lambda joints: Posture(pose=controller.forward(joints)), limited

    def _limits(self, robot: str) -> LimitsConfig:
        return self._config.limits if robot == self._config.robot.name else LimitsConfig()

    def _controller(self, robot: str) -> str:
        if self._config.control is not None:
            return self._config.control.controller
        names = sorted(self._registry().specs("controller"))
        if len(names) != 1:
            raise ConfigurationError(
                f"Nothing tells where the joints would bring {robot!r}: the configuration names no controller"
                + (f", installed are {', '.join(names)}." if names else " and none is installed."),
                hint="Install one (rn-controller-urdf) and name it in [control].",
            )
        return names[0]
