"""Building what plugins offer, inside a module process."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import cast

from roboneuron.config import ControlConfig
from roboneuron.contract import RobotProfile
from roboneuron.errors import ConfigurationError, PluginError
from roboneuron.modules.settings import ModuleKind
from roboneuron.planning import Plan
from roboneuron.plugins.availability import install_command, package_of
from roboneuron.plugins.loading import load_attribute, load_options, load_target
from roboneuron.plugins.registry import Registry
from roboneuron.plugins.specs import DriverSpec, FeatureSpec, RobotSpec, Spec

_CLASSES: Mapping[ModuleKind, str] = {
    "robot": "roboneuron.modules.robot:RobotModule",
    "control": "roboneuron.modules.control:ControlModule",
}
"""Modules that move the arm; the features that are called as them bring the others."""


def module_class(kind: ModuleKind, registry: Registry) -> str:
    """What a module process of that kind runs, "module:attribute"; imported in that process alone.

    Raises:
        ConfigurationError: no installed feature brings such modules.
    """
    brought = registry.specs(FeatureSpec).get(kind)
    found = _CLASSES.get(kind) or (brought.module if brought is not None else None)
    if found is None:
        package = package_of("feature", kind)
        raise ConfigurationError(
            f"No feature that runs {kind} modules is installed.",
            hint=f"For its interpreter: {install_command(*filter(None, [package]))}. "
            f"If that is installed, take rn-{kind} out of disabled_plugins.",
        )
    return found


def build(
    spec: Spec | DriverSpec, options: Mapping[str, object], *arguments: object, **parts: object
) -> object:
    """Import the spec's target and call it with its validated options and the given arguments.

    Raises:
        MissingDependencyError, ConfigurationError, PluginError: as `load_target` and
            `load_options`.
    """
    target = cast("Callable[..., object]", load_target(spec))
    return target(load_options(spec, options), *arguments, **parts)


def load_profile(registry: Registry, robot: str) -> RobotProfile:
    """The profile of the robot called `robot`.

    Raises:
        ConfigurationError: no installed plugin offers it.
        PluginError: its target returns something else.
    """
    profile = cast("Callable[[], object]", load_target(registry.get(RobotSpec, robot)))()
    if not isinstance(profile, RobotProfile):
        raise PluginError(
            f"The target of robot {robot!r} returned {type(profile).__name__}, expected "
            "RobotProfile."
        )
    return profile


def check_module(
    kind: ModuleKind,
    registry: Registry,
    plan: Plan,
    options: Mapping[str, object],
    control: ControlConfig | None,
) -> None:
    """Let the feature that brings modules of that kind check one before it is started.

    Args:
        plan: what it consists of.
        options: of the plugin that it runs.
        control: section of the configuration.

    Raises:
        RoboNeuronError: as `FeatureSpec.module_check` says.
    """
    spec = registry.specs(FeatureSpec).get(kind)
    if spec is not None and spec.module_check is not None:
        check = load_attribute(spec.module_check, f"`module_check` of {spec.name!r}")
        cast("Callable[..., object]", check)(registry, plan, options, control)
