"""Features, which installed plugins add to the server: loaded in the order of their dependencies,
isolated from each other's faults.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from roboneuron.config import Config, feature_options, transport_feature
from roboneuron.errors import ConfigurationError, InternalError, PluginError, RoboNeuronError
from roboneuron.planning import KindEntry, added_kind
from roboneuron.plugins.loading import load_target
from roboneuron.plugins.registry import Registry
from roboneuron.plugins.specs import FeatureSpec

if TYPE_CHECKING:
    from roboneuron.gate import StillReason
    from roboneuron.server.clock import RobotClock
    from roboneuron.server.host import Host
    from roboneuron.server.interception import Interceptor, Simulator
    from roboneuron.server.loop import StartForm
    from roboneuron.server.motion_gate import MotionGate
    from roboneuron.server.registry import ToolRegistry
    from roboneuron.server.tool import CallContext, Resource, Tool, Transport

log = logging.getLogger(__name__)
OptionsT = TypeVar("OptionsT")


class Feature(Generic[OptionsT]):
    """Base class of all features; override the methods that the feature needs.

    Built as `target(options)` in the server's process; `options` is an instance of the descriptor's
    `config`, or None without one. The constructor has no side effect; `start` begins the work and
    `close` undoes it.
    """

    def __init__(self, options: OptionsT) -> None:
        self.options = options

    @property
    def identifies_clients(self) -> bool:
        """True if it distinguishes clients by a secret such as a token."""
        return False

    @property
    def gate(self) -> MotionGate | None:
        """The gate, provided to other features as `Host.gate`; None for all features but the one
        that sends commands.
        """
        return None

    @property
    def is_moving(self) -> bool:
        """True if it moves a robot now, beside the calls and the policy that claim it."""
        return bool(self.motions)

    @property
    def motions(self) -> Sequence[str]:
        """What of it moves a robot now, beside the calls and the policy that claim it: a phrase
        each, such as "run_task 'pick' of ann"; from any thread.
        """
        return ()

    @property
    def omitted(self) -> Sequence[str]:
        """What of its configuration cannot be used and is left out, a sentence each; for `config
        check` and get_status. From any thread.
        """
        return ()

    def clock(self, namespace: str) -> RobotClock | None:
        """Time of the robot in that namespace, if it is not the real one; at most one feature
        offers it. From any thread.
        """
        return None

    def still_reasons(self, asker: CallContext | None) -> Iterable[StillReason]:
        """Why the robot does not move, by this feature, see `Host.why_still`; must not block. From
        any thread.

        Args:
            asker: the client; None for the reasons that hold for every client.
        """
        return ()

    def check(self, config: Config) -> None:
        """Check what the options alone do not show (files, environment); for `config check` and
        before `listen`.

        Raises:
            ConfigurationError: the server would not work with it.
        """

    def reserve(self, config: Config) -> None:
        """Reserve, or check, an exclusive resource such as a port. Called once, before `listen`.

        `config check` does not call it, because a running server may rightly hold the resource.

        Raises:
            ConfigurationError: another process holds it.
        """

    def start_forms(self, host: Host) -> Sequence[StartForm]:
        """How clients ask for modules that are not started as configured, at most one for each
        kind of all features. Called once, before `tools` of any feature.
        """
        return ()

    def tools(self, host: Host) -> Sequence[Tool[Any]]:
        """Tools for the agent. Called once, before clients are served; `host` may be kept."""
        return ()

    def interceptors(self, host: Host) -> Sequence[Interceptor]:
        """Steps that tool calls pass, see docs/interceptors.md. Called once, after `tools`."""
        return ()

    def simulator(self, host: Host) -> Simulator | None:
        """What simulates calls instead of carrying them out; at most one feature offers it. Called
        once, after `tools`.
        """
        return None

    def resources(self, host: Host) -> Sequence[Resource]:
        """Resources for the agent. Called once, after `tools`."""
        return ()

    def complete(self, host: Host) -> None:
        """Process what the other features have added. Called once, after `tools` of all features.

        Raises:
            RoboNeuronError: the server must not start, whether or not the configuration asks for
                this feature.
        """

    def end_motion(self, reason: str, timeout_s: float) -> bool:
        """End all its motions at the end of the server, before modules stop; return True if they
        ended in time.
        """
        return True

    def attach(self, host: Host) -> None:
        """Add prompts, subscriptions or questions to `host.server`.

        Called once, after `tools`. A server of several robots calls it for the first robot only,
        with a host whose `server` and `events` cover all robots.
        """

    def start(self, host: Host) -> None:
        """Start threads and subscriptions. Called once, when the server begins to serve; must
        return quickly.

        Raises:
            RoboNeuronError: it cannot work; the server continues without it unless the
                configuration names it.
        """

    def listen(self, host: Host) -> Transport:
        """Start listening for clients. Called once, after `tools`, if `[server] transport` is one
        of the descriptor's.

        Modules and ROS are not started yet. The transport attaches a
        `roboneuron.server.tool.Holder` to each request.

        Raises:
            ConfigurationError: it cannot listen, for example because a port is in use.
        """
        raise NotImplementedError(f"{type(self).__name__} serves no transport.")

    def close(self) -> None:
        """Release everything; may be called twice and before `start`."""


class Features:
    """Load, start and close features.

    A feature that the configuration asks for (by one of its sections, or in `features`) must work:
    its failure is raised. Any other failure is logged, and that feature is left out.

    Attributes:
        loaded: features by name, dependencies first; replaced, never modified, so that any thread
            may read it.
        failed: features left out, with the reasons.
        kinds: entries of the kinds of modules that features add.
    """

    def __init__(self, config: Config, registry: Registry) -> None:
        self._config = config
        self._registry = registry
        self._specs = registry.specs(FeatureSpec)
        self.loaded: dict[str, Feature[Any]] = {}
        self.failed: dict[str, str] = {}
        self.kinds: dict[str, KindEntry] = {}
        for name in config.features:
            registry.get(FeatureSpec, name)  # says why a required feature is missing
        for spec in _ordered(self._specs):
            self._attempt(spec, "loaded", partial(self._load, spec))

    @property
    def on_join(self) -> tuple[str, ...]:
        """Functions that every module calls once it has joined ROS."""
        return tuple(
            reference
            for name in self.loaded
            if (reference := self._specs[name].on_join) is not None
        )

    @property
    def omitted(self) -> list[str]:
        """What of the configuration all features leave out, a sentence each."""
        return [reason for feature in self.loaded.values() for reason in feature.omitted]

    def still_reasons(self, asker: CallContext | None) -> list[StillReason]:
        """Why the robot does not move, by all features, see `Feature.still_reasons`."""
        reasons: list[StillReason] = []
        for name, feature in self.loaded.items():
            try:
                reasons += feature.still_reasons(asker)
            except Exception:  # the border to a plugin's own code; the others give theirs
                log.exception("The feature %r could not say why the robot does not move.", name)
        return reasons

    def listen(self, host: Host) -> Transport:
        """Let every feature reserve its resources, and the one of the configured transport listen.
        Raises ConfigurationError as `transport_feature`.
        """
        spec = transport_feature(self._config.server.transport, self._registry)
        self.each("started", lambda feature: feature.reserve(self._config))
        return self.loaded[spec.name].listen(host)

    def offer(self, host: Host, tools: ToolRegistry) -> list[Resource]:
        """Add every feature's tools and interceptors, and return all their resources."""
        resources: list[Resource] = []

        def add(feature: Feature[Any]) -> None:
            tools.add_all(feature.tools(host))
            tools.chain.intercept(feature.interceptors(host))
            simulator = feature.simulator(host)
            if simulator is not None:
                tools.chain.simulate_with(simulator)
            resources.extend(feature.resources(host))

        self.each(
            "asked for its start forms",
            lambda feature: host.loop.accept(feature.start_forms(host)),
        )
        self.each("asked for its tools", add)
        for name in self.failed:
            tools.replace_derived(name, ())
        self.each("completed", lambda feature: feature.complete(host), must_work=True)
        return resources

    def start(self, host: Host) -> None:
        """Start every feature."""
        self.each("started", lambda feature: feature.start(host))

    def close(self) -> None:
        """Close every feature in the reverse order; idempotent."""
        for name, feature in reversed(self.loaded.items()):
            try:
                feature.close()
            except Exception:  # the border to a plugin's own code
                log.exception("The feature %r could not be closed.", name)

    def each(
        self, what: str, work: Callable[[Feature[Any]], object], *, must_work: bool = False
    ) -> None:
        """Call `work` for every feature; a feature that fails is left out, or its failure raised.

        Args:
            what: the action, for the message, such as "started".
            work: called with each feature.
            must_work: raise the failure also for a feature that was not asked for.
        """
        for name, feature in self.loaded.items():
            self._attempt(self._specs[name], what, partial(work, feature), must_work=must_work)

    def _load(self, spec: FeatureSpec) -> None:
        absent = [need for need in spec.needs if need not in self.loaded]
        if absent:
            raise ConfigurationError(f"It needs the feature {absent[0]!r}, which is not there.")
        target = load_target(spec)
        if not callable(target):
            raise PluginError(
                f"The target of feature {spec.name!r} is {target!r}, expected a class."
            )
        kind = added_kind(spec)
        is_idle = kind is not None and spec.name not in self._config.sections
        feature = target(None if is_idle else feature_options(spec, self._config))
        if not isinstance(feature, Feature):
            raise PluginError(
                f"The target of feature {spec.name!r} makes a {type(feature).__name__}, not a "
                "Feature."
            )
        if kind is not None:
            self.kinds[spec.name] = kind
        self.loaded = {**self.loaded, spec.name: feature}

    def _attempt(
        self, spec: FeatureSpec, what: str, work: Callable[[], object], *, must_work: bool = False
    ) -> None:
        try:
            work()
        except Exception as error:  # the border to a plugin's own code
            if must_work and isinstance(error, RoboNeuronError):
                raise
            if not isinstance(error, RoboNeuronError):
                log.exception("The feature %r failed.", spec.name)
                reason = f"{type(error).__name__}: {error}"
            else:
                reason = str(error)
            said = f"The feature {spec.name!r} could not be {what}: {reason}"
            feature = self.loaded.get(spec.name)
            self.loaded = {name: one for name, one in self.loaded.items() if one is not feature}
            if feature is not None:
                feature.close()
            if (
                spec.name in self._config.features
                or self._config.server.transport in spec.transports
                or any(key in self._config.sections for key in spec.keys)
            ):
                kind = type(error) if isinstance(error, RoboNeuronError) else PluginError
                raise kind(said) from error
            self.failed[spec.name] = reason
            log.error("%s", said)


def _ordered(specs: Mapping[str, FeatureSpec]) -> list[FeatureSpec]:
    """Sort features by their dependencies; by name otherwise.

    Raises:
        InternalError: the dependencies are cyclic.
    """
    ordered: dict[str, FeatureSpec] = {}

    def visit(name: str, above: tuple[str, ...] = ()) -> None:
        if name in above:
            raise InternalError(f"Features need each other: {' -> '.join([*above, name])}.")
        if name in specs and name not in ordered:
            for need in specs[name].needs:
                visit(need, (*above, name))
            ordered[name] = specs[name]

    for name in specs:
        visit(name)
    return list(ordered.values())
