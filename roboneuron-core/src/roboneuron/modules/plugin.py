"""Building what plugins offer, inside a module process."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import cast

from roboneuron.config import ControlConfig
from roboneuron.contract import (
    EE_DELTA,
    SPACE_KINDS,
    ControlSpace,
    RobotProfile,
    SpaceAgreement,
    agree,
)
from roboneuron.errors import ConfigurationError, PluginError
from roboneuron.modules.settings import HOLD_SHARE, ModuleKind
from roboneuron.plugins.availability import install_command, package_of
from roboneuron.plugins.loading import load_attribute, load_options, load_target
from roboneuron.plugins.registry import Registry
from roboneuron.plugins.specs import BackendSpec, ControllerSpec, DriverSpec, FeatureSpec, Spec

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
    profile = cast("Callable[[], object]", load_target(registry.get("robot", robot)))()
    if not isinstance(profile, RobotProfile):
        raise PluginError(
            f"The target of robot {robot!r} returned {type(profile).__name__}, expected "
            "RobotProfile."
        )
    return profile


def agree_on_space(
    registry: Registry,
    backend: BackendSpec,
    options: Mapping[str, object],
    robot: str,
    control: ControlConfig | None,
) -> SpaceAgreement:
    """What the backend yields with these options, as the configured controller executes it.

    Args:
        registry: what is installed.
        backend: its descriptor.
        options: of the backend, with its checkpoint.
        robot: name of the robot.
        control: section of the configuration; None: every space is taken.

    Raises:
        PlanningError: they do not fit, see `agree`.
        ConfigurationError, PluginError: something named cannot be used, or the descriptor does not
            fit its space; as what declares the space.
    """
    profile = load_profile(registry, robot)
    declared: object = EE_DELTA
    if backend.space is not None:
        declare = cast(
            "Callable[..., object]",
            load_attribute(backend.space, f"`space` of {backend.name!r}"),
        )
        declared = declare(options, profile)
    if not isinstance(declared, ControlSpace):
        raise PluginError(
            f"The `space` of {backend.name!r} returned {type(declared).__name__}, expected "
            "ControlSpace."
        )
    if declared.kind == "joint_delta" and not backend.needs_state:
        raise PluginError(
            f"Backend {backend.name!r} yields joint_delta, which is relative to the measured "
            "joints, but its descriptor does not say needs_state."
        )
    kinds: tuple[str, ...] = SPACE_KINDS
    name, longest_s = "", None
    if control is not None:
        name = control.controller
        kinds = registry.get(ControllerSpec, name, elsewhere=True).spaces
        longest_s = control.action_timeout_s * HOLD_SHARE
    return agree(
        declared, profile, kinds, backend=backend.name, controller=name, longest_s=longest_s
    )
