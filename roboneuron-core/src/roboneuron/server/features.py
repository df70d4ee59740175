"""The features of one server: loaded in the order of their needs, each isolated from the others' faults."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

from roboneuron.config import STDIO, Config, feature_options, transport_feature
from roboneuron.errors import ConfigurationError, InternalError, PluginError, RoboNeuronError
from roboneuron.plugins.loading import load_target
from roboneuron.plugins.registry import Registry
from roboneuron.plugins.specs import FeatureSpec
from roboneuron.server.feature import Feature, Resource, Transport
from roboneuron.server.host import Host
from roboneuron.server.registry import ToolRegistry

if TYPE_CHECKING:
    from mcp.server.context import ServerRequestContext
    from mcp.types import CallToolRequestParams

log = logging.getLogger(__name__)


class Features:
    """Loads, starts and closes features; `failed` tells which are left out and why.

    A feature that the configuration asks for (by one of its sections, or in `features`) must work: its failure is
    raised. Any other failure is logged and leaves that feature out.
    """

    def __init__(self, config: Config, registry: Registry) -> None:
        self._config = config
        self._specs = registry.specs("feature")
        self._loaded: dict[str, Feature[Any]] = {}
        self.failed: dict[str, str] = {}
        for name in config.features:
            registry.get("feature", name)  # says why a feature that must be there is not
        transport = config.server.transport
        self._transport = None if transport == STDIO else transport_feature(transport, registry).name
        for spec in _ordered(self._specs):
            self._attempt(spec, "loaded", partial(self._load, spec))

    def get(self, name: str) -> Feature[Any] | None:
        """A loaded feature, or None."""
        return self._loaded.get(name)

    @property
    def on_join(self) -> tuple[str, ...]:
        """What every module calls once it has joined ROS."""
        return tuple(reference for spec, _ in self._all() if (reference := spec.on_join) is not None)

    @property
    def identifies_clients(self) -> bool:
        """Whether one of them tells clients apart by what they alone know."""
        return any(feature.identifies_clients for _, feature in self._all())

    async def ask(
        self, request: ServerRequestContext[Any, Any], params: CallToolRequestParams, question: str
    ) -> bool | None:
        """See `Feature.ask`: by the first feature that can."""
        for _, feature in self._all():
            agreed = await feature.ask(request, params, question)
            if agreed is not None:
                return agreed
        return None

    def check(self) -> None:
        """Have every feature check its part of the configuration."""
        for spec, feature in self._all():
            self._attempt(spec, "used", partial(feature.check, self._config))

    def listen(self, host: Host) -> Transport | None:
        """Have the feature listen that serves the configured transport; None for stdio."""
        return None if self._transport is None else self._loaded[self._transport].listen(host)

    def offer(self, host: Host, tools: ToolRegistry) -> list[Resource]:
        """Add every feature's tools, and return all their resources."""
        resources: list[Resource] = []
        for spec, feature in self._all():

            def add(feature: Feature[Any] = feature) -> None:
                tools.add_all(feature.tools(host))
                resources.extend(feature.resources(host))

            self._attempt(spec, "asked for its tools", add)
            if spec.name in self.failed:
                tools.replace_derived(spec.name, ())
        return resources

    def start(self, host: Host) -> None:
        """Start every feature."""
        for spec, feature in self._all():
            self._attempt(spec, "started", partial(feature.start, host))

    def close(self) -> None:
        """Close every feature in the reverse order; idempotent."""
        for name, feature in reversed(self._loaded.items()):
            try:
                feature.close()
            except Exception:  # the border to a plugin's own code
                log.exception("The feature %r could not be closed.", name)

    def _all(self) -> Iterator[tuple[FeatureSpec, Feature[Any]]]:
        for name, feature in list(self._loaded.items()):
            yield self._specs[name], feature

    def _load(self, spec: FeatureSpec) -> None:
        absent = [need for need in spec.needs if need not in self._loaded]
        if absent:
            raise ConfigurationError(f"It needs the feature {absent[0]!r}, which is not there.")
        target = load_target(spec)
        if not callable(target):
            raise PluginError(f"The target of feature {spec.name!r} is {target!r}, expected a class.")
        feature = target(feature_options(spec, self._config))
        if not isinstance(feature, Feature):
            raise PluginError(f"The target of feature {spec.name!r} makes a {type(feature).__name__}, not a Feature.")
        self._loaded[spec.name] = feature

    def _attempt(self, spec: FeatureSpec, what: str, work: Callable[[], object]) -> None:
        try:
            work()
        except Exception as error:  # the border to a plugin's own code
            if not isinstance(error, RoboNeuronError):
                log.exception("The feature %r failed.", spec.name)
                reason = f"{type(error).__name__}: {error}"
            else:
                reason = str(error)
            said = f"The feature {spec.name!r} could not be {what}: {reason}"
            feature = self._loaded.pop(spec.name, None)
            if feature is not None:
                feature.close()
            if self._is_asked_for(spec):
                kind = type(error) if isinstance(error, RoboNeuronError) else PluginError
                raise kind(said) from error
            self.failed[spec.name] = reason
            log.error("%s", said)

    def _is_asked_for(self, spec: FeatureSpec) -> bool:
        sections = any(key in self._config.sections for key in spec.keys)
        return sections or spec.name in self._config.features or self._config.server.transport in spec.transports


def _ordered(specs: Mapping[str, FeatureSpec]) -> list[FeatureSpec]:
    """Those that others need first; by name otherwise.

    Raises:
        InternalError: features need each other in a circle.
    """
    ordered: list[FeatureSpec] = []
    open_names: list[str] = []

    def visit(name: str) -> None:
        spec = specs.get(name)
        if spec is None or spec in ordered:
            return
        if name in open_names:
            raise InternalError(f"Features need each other: {' -> '.join([*open_names, name])}.")
        open_names.append(name)
        for need in spec.needs:
            visit(need)
        open_names.pop()
        ordered.append(spec)

    for name in specs:
        visit(name)
    return ordered
