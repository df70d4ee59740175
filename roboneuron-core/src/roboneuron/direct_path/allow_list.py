"""Allow list of direct motion: endpoints of the robot's profile and of features, checked together,
effective at once.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

from roboneuron.config import models
from roboneuron.config.models import Config
from roboneuron.direct_path.exposed import (
    action_endpoint,
    allowed_endpoint,
    check_reserved,
    check_stop,
    lead_endpoint,
    profile_endpoints,
    same_for_each_topic,
)
from roboneuron.direct_path.gate import Gate
from roboneuron.direct_path.limits import check_endpoint
from roboneuron.direct_path.plans import check_plan_frame
from roboneuron.direct_path.request import AllowedEndpoint
from roboneuron.errors import ConfigurationError
from roboneuron.modules.arm_paths import ArmPaths
from roboneuron.modules.plugin import load_profile
from roboneuron.plugins.registry import Registry
from roboneuron.plugins.specs import RobotSpec
from roboneuron.server.motion_gate import ExposedEndpoint


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
        # held over a whole change, which is taken back if one endpoint is refused
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
        return profile_endpoints(name, config.namespace, load_profile(registry, config.robot))

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
