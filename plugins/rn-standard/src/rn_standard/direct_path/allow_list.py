"""Allow list of direct motion: endpoints of the robot's profile and of features, checked together,
effective at once.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import cast

from rn_standard.direct_path.exposed import (
    action_endpoint,
    allowed_endpoint,
    check_reserved,
    check_stop,
    lead_endpoint,
    profile_endpoints,
    same_for_each_topic,
)
from rn_standard.direct_path.gate import Gate
from rn_standard.direct_path.limits import check_endpoint
from rn_standard.direct_path.path_limits import PathLimiter
from rn_standard.direct_path.plans import check_plan_frame
from rn_standard.direct_path.request import AllowedEndpoint
from roboneuron import (
    ConfigurationError,
    Controller,
    ControllerSpec,
    RobotProfile,
    RobotSpec,
)
from roboneuron.feature import (
    Config,
    ExposedEndpoint,
    MotionRules,
    Registry,
    build,
    inspector_of,
    load_profile,
    models,
    motion_rules,
)

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
        name = self._controller(robot)
        with self._lock:
            if (robot, name) not in self._made:
                controller, limited = self.load(robot, profile)
                self._made[robot, name] = PathLimiter(
                    self.rules(robot, profile), limited, inspector_of(controller)
                )
            return self._made[robot, name]

    def load(self, robot: str, profile: RobotProfile) -> tuple[Controller, RobotProfile]:
        """Create a controller of an arm for one user, and the profile with the collisions in force.
        Raises as `limiter`.
        """
        limited = replace(profile, collision=self.rules(robot, profile).collision)
        name = self._controller(robot)
        spec = self._registry().get(ControllerSpec, name)
        controller = cast("Controller", build(spec, self._config.options(name), limited))
        controller.load()
        return controller, limited

    def _limits(self, robot: str) -> models.LimitsConfig:
        return self._limits_now() if robot == self._config.robot.name else models.LimitsConfig()

    def _controller(self, robot: str) -> str:
        if self._config.control is not None:
            return self._config.control.controller
        names = sorted(self._registry().specs(ControllerSpec))
        if len(names) != 1:
            raise ConfigurationError(
                f"Nothing can compute where the joints would move {robot!r}: the configuration "
                "names "
                "no controller"
                + (f", installed are {', '.join(names)}." if names else " and none is installed."),
                hint="Install one (rn-controller-urdf) and name it in [control].",
            )
        return names[0]


class AllowList:
    """Exposed endpoints by owner; usable from any thread.

    Unless a feature exposes others instead, these are the endpoints of the robot's profile. Limits
    belong to topics: if two features expose one topic, the limits of both apply.

    Attributes:
        exposed: the endpoints in force; they include the action topic of an arm, hidden.
    """

    def __init__(
        self,
        gate: Gate,
        config: Callable[[], Config],
        registry: Callable[[], Registry],
        limits: Callable[[], models.LimitsConfig],
        on_change: Callable[[], object],
    ) -> None:
        """Args:
        gate: applies the list.
        config: returns the configuration with the present robot.
        registry: returns the installed plugins.
        limits: see `ArmPaths`.
        on_change: called after each change, on the changing thread.
        """
        self._gate = gate
        self._config = config
        self._registry = registry
        self._paths = ArmPaths(config(), registry, limits)
        self._lock = threading.RLock()
        self._by_owner: dict[str, tuple[ExposedEndpoint, ...]] = {}
        self._instead: frozenset[str] = frozenset()
        self.exposed: tuple[ExposedEndpoint, ...] = ()
        self._on_change = on_change

    def expose(
        self, owner: str, endpoints: Sequence[ExposedEndpoint], *, instead_of_profile: bool = False
    ) -> None:
        """Set the endpoints of an owner; they replace all its previous ones.

        Args:
            owner: name of the feature.
            endpoints: with names and limits.
            instead_of_profile: the endpoints of the robot's profile are exposed only if they are
                among these.

        Raises:
            ConfigurationError: one may not be exposed, or two contradict each other; the old list
                stays.
            PluginError, MissingDependencyError: the robot's profile cannot be loaded.
        """
        with self._lock:
            before = self._by_owner, self._instead
            self._by_owner = {**self._by_owner, owner: tuple(endpoints)}
            if instead_of_profile:
                self._instead |= {owner}
            try:
                self._apply()
            except Exception:
                self._by_owner, self._instead = before
                raise
        self._on_change()

    def relimit(self) -> None:
        """Apply the limits that are in force now. Raises as `expose`; the old limits stay then."""
        with self._lock:
            self._apply()
            self._paths.forget()

    def refresh(self) -> None:
        """Expose the present robot's profile, unless a feature exposes others instead. Raises as
        `expose`.
        """
        with self._lock:
            if not self._instead:
                self._apply()
        self._on_change()

    def _apply(self) -> None:
        listed = [
            *self._profile(),
            *(e for endpoints in self._by_owner.values() for e in endpoints),
        ]
        if len(self._by_owner) > 1 or not self._instead:
            listed = same_for_each_topic(listed, {})
        config = self._config()
        robots = {
            config.namespace: config.robot.name,
            **{e.namespace: e.robot for e in listed if not e.hidden},
        }
        names: set[tuple[str, str]] = set()
        for exposed in listed:
            check_reserved(exposed, robots)
            check_endpoint(exposed.endpoint)
            check_stop(exposed)
            if exposed.profile is not None and exposed.endpoint.joint_limited:
                check_plan_frame(exposed.endpoint, exposed.profile.base_link)
            name = exposed.robot, exposed.endpoint.name
            if name in names:
                raise ConfigurationError(
                    f"Two endpoints of {exposed.robot!r} are called {exposed.endpoint.name!r}."
                )
            names.add(name)
        arm = next(
            (e for e in listed if e.robot == config.robot.name and e.profile is not None), None
        )
        hidden = [] if arm is None else [action_endpoint(arm), lead_endpoint(arm)]
        made = (*listed, *(exposed for exposed in hidden if exposed is not None))
        self._gate.replace(map(self._allowed, made))
        self.exposed = made

    def _profile(self) -> list[ExposedEndpoint]:
        config, registry = self._config(), self._registry()
        name = config.robot.name
        if self._instead or name not in registry.specs(RobotSpec):
            return []
        return profile_endpoints(name, config.namespace, load_profile(registry, name))

    def _allowed(self, exposed: ExposedEndpoint) -> AllowedEndpoint:
        """Create the gate's entry; joint motions of an arm with a TCP get the limits that apply to
        actions.
        """
        entry, profile = allowed_endpoint(exposed), exposed.profile
        if not exposed.endpoint.joint_limited or profile is None or not profile.tcp_link:
            return entry
        rules = self._paths.rules(exposed.robot, profile)
        return replace(
            entry, rules=rules, path=partial(self._paths.limiter, exposed.robot, profile)
        )
