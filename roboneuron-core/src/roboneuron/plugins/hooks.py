"""The hooks that may be implemented: those of core, and those that installed features bring."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from types import ModuleType

from roboneuron.errors import PluginError
from roboneuron.plugins import hookspecs
from roboneuron.plugins.descriptor import NAME_PATTERN, TARGET_PATTERN
from roboneuron.plugins.specs import KINDS, FeatureSpec, Spec


@dataclass(frozen=True, kw_only=True, slots=True)
class Hooks:
    """Hook names with the class of the descriptors they return, and where their specifications are.

    Attributes:
        specs: descriptor class by hook name, in the order in which hooks are called.
        containers: modules that hold the functions decorated with `hookspec`.
    """

    specs: Mapping[str, type[Spec]] = field(
        default_factory=lambda: {hook: KINDS[kind] for kind, hook in hookspecs.HOOKS.items()}
    )
    containers: tuple[ModuleType, ...] = (hookspecs,)

    @property
    def kinds(self) -> Mapping[str, type[Spec]]:
        """Descriptor class by kind."""
        return {spec.kind: spec for spec in self.specs.values()}

    def extended(self, features: Iterable[FeatureSpec]) -> Hooks:
        """These hooks and those that the features bring.

        Raises:
            PluginError: a feature's `hooks` cannot be imported, is no mapping from hook names to descriptor classes,
                or claims a hook or a kind that is there already.
        """
        specs, containers = dict(self.specs), list(self.containers)
        for feature in features:
            if feature.hooks is None:
                continue
            module, brought = _load(feature)
            known = {spec.kind for spec in specs.values()}
            for hook, spec in brought.items():
                if hook in specs or spec.kind in known:
                    raise PluginError(f"Feature {feature.name!r} brings the hook {hook}, which is there already.")
                if not callable(getattr(module, hook, None)):
                    raise PluginError(f"Feature {feature.name!r} names the hook {hook}, but does not specify it.")
                specs[hook] = spec
            containers.append(module)
        return Hooks(specs=specs, containers=tuple(containers))


def _load(feature: FeatureSpec) -> tuple[ModuleType, Mapping[str, type[Spec]]]:
    assert feature.hooks is not None
    if not TARGET_PATTERN.fullmatch(feature.hooks):
        raise PluginError(f"The `hooks` of feature {feature.name!r} is {feature.hooks!r}, expected 'module:attribute'.")
    name, _, attribute = feature.hooks.partition(":")
    who = f"`hooks` of feature {feature.name!r} ({feature.hooks})"
    try:
        module = import_module(name)
        brought = getattr(module, attribute)
    except Exception as error:  # the border to a plugin's own code
        raise PluginError(f"The {who} cannot be loaded: {type(error).__name__}: {error}") from error
    if not isinstance(brought, Mapping) or not all(_is_entry(hook, spec) for hook, spec in brought.items()):
        raise PluginError(f"The {who} are {brought!r}, expected a mapping from hook names to descriptor classes.")
    return module, brought


def _is_entry(hook: object, spec: object) -> bool:
    return (
        isinstance(hook, str)
        and hook.startswith("roboneuron_")
        and isinstance(spec, type)
        and issubclass(spec, Spec)
        and NAME_PATTERN.fullmatch(spec.kind) is not None
    )
