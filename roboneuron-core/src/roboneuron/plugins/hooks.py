"""The hooks that may be implemented: those of core, and those that installed features and commands bring."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from types import ModuleType

from roboneuron.errors import PluginError
from roboneuron.plugins import hookspecs
from roboneuron.plugins.descriptor import NAME_PATTERN, TARGET_PATTERN
from roboneuron.plugins.specs import KINDS, CommandSpec, FeatureSpec, Spec


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

    def extended(self, bringing: Iterable[FeatureSpec | CommandSpec]) -> Hooks:
        """These hooks and those that features and commands bring.

        Raises:
            PluginError: their `hooks` cannot be imported, is no mapping from hook names to descriptor classes,
                or claims a hook or a kind that is there already.
        """
        specs, containers = dict(self.specs), list(self.containers)
        for bringer in bringing:
            if bringer.hooks is None:
                continue
            who = f"{bringer.kind.capitalize()} {bringer.name!r}"
            module, brought = _load(bringer)
            known = {spec.kind for spec in specs.values()}
            for hook, spec in brought.items():
                if hook in specs or spec.kind in known:
                    raise PluginError(f"{who} brings the hook {hook}, which is there already.")
                if not callable(getattr(module, hook, None)):
                    raise PluginError(f"{who} names the hook {hook}, but does not specify it.")
                specs[hook] = spec
            containers.append(module)
        return Hooks(specs=specs, containers=tuple(containers))


def _load(bringer: FeatureSpec | CommandSpec) -> tuple[ModuleType, Mapping[str, type[Spec]]]:
    assert bringer.hooks is not None
    of = f"`hooks` of {bringer.kind} {bringer.name!r}"
    if not TARGET_PATTERN.fullmatch(bringer.hooks):
        raise PluginError(f"The {of} is {bringer.hooks!r}, expected 'module:attribute'.")
    name, _, attribute = bringer.hooks.partition(":")
    who = f"{of} ({bringer.hooks})"
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
