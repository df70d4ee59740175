"""Construction of plugin objects inside a module process."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import cast

from roboneuron.contract import RobotProfile
from roboneuron.errors import PluginError
from roboneuron.plugins.loading import load_options, load_target
from roboneuron.plugins.registry import Registry
from roboneuron.plugins.specs import DriverSpec, RobotSpec, Spec


def build(
    spec: Spec | DriverSpec, options: Mapping[str, object], *arguments: object, **parts: object
) -> object:
    """Import the spec's target and call it with its validated options and the given arguments.

    Raises:
        MissingDependencyError, ConfigurationError, PluginError: see `load_target` and
            `load_options`.
    """
    target = cast("Callable[..., object]", load_target(spec))
    return target(load_options(spec, options), *arguments, **parts)


def load_profile(registry: Registry, robot: str) -> RobotProfile:
    """Return the profile of the robot called `robot`.

    Raises:
        ConfigurationError: no installed plugin offers it.
        PluginError: its target returns another type.
    """
    profile = cast("Callable[[], object]", load_target(registry.get(RobotSpec, robot)))()
    if not isinstance(profile, RobotProfile):
        raise PluginError(
            f"The target of robot {robot!r} returned {type(profile).__name__}, expected "
            "RobotProfile."
        )
    return profile
