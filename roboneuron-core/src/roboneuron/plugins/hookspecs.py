"""The hooks. Each takes no arguments, imports nothing heavy and returns a sequence of frozen
descriptors.

A plugin is a distribution with an entry point in the group `roboneuron`. The entry point names a
module with any of these functions, decorated with `hookimpl`. `HOOKS` are those of core; installed
features may add more.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping, Sequence

import pluggy

from roboneuron.errors import PluginError
from roboneuron.plugins.descriptor import NAME_PATTERN
from roboneuron.plugins.loading import load_attribute
from roboneuron.plugins.specs import (
    PLUGIN_KINDS,
    AccelerationSpec,
    BackendSpec,
    CommandSpec,
    ControllerSpec,
    FeatureSpec,
    LocatorSpec,
    PerceptionSpec,
    RobotSpec,
    RuntimeSpec,
    Spec,
)

PROJECT = "roboneuron"
"""Name of the pluggy project and of the entry-point group."""

hookspec = pluggy.HookspecMarker(PROJECT)
hookimpl = pluggy.HookimplMarker(PROJECT)


@hookspec
def roboneuron_backends() -> Sequence[BackendSpec]:  # type: ignore[empty-body]
    """Offer policies: image and instruction to actions.

    `target` follows the protocol `Backend`; it is built as `target(config, runtime=...,
    acceleration=...)` in the inference module, in a separate process. The agent sees each as a
    choice of `start_inference`.
    """


@hookspec
def roboneuron_runtimes() -> Sequence[RuntimeSpec]:  # type: ignore[empty-body]
    """Offer engines that execute decoders for backends.

    `target` follows the protocol `Runtime`; it is built as `target(config)` in the inference module
    and handed to a backend whose `family` is among `families`.
    """


@hookspec
def roboneuron_accelerations() -> Sequence[AccelerationSpec]:  # type: ignore[empty-body]
    """Offer named presets that change how a loaded model is executed.

    `target` follows the protocol `Acceleration`; it is built as `target(config)` in the inference
    module and applied by a runtime that offers its `capability`.
    """


@hookspec
def roboneuron_perceptions() -> Sequence[PerceptionSpec]:  # type: ignore[empty-body]
    """Offer sources of camera frames.

    `target` follows the protocol `PerceptionSource`; it is built as `target(config, topics,
    cameras)` in the perception module, in a separate process.
    """


@hookspec
def roboneuron_controllers() -> Sequence[ControllerSpec]:  # type: ignore[empty-body]
    """Offer controllers from actions to joint commands.

    `target` follows the protocol `Controller`; it is built as `target(config, profile)` in the
    control module, in a separate process.
    """


@hookspec
def roboneuron_robots() -> Sequence[RobotSpec]:  # type: ignore[empty-body]
    """Offer robots.

    `target` is a function without arguments that returns the `RobotProfile`; each driver's `target`
    follows the protocol `RobotDriver` and is built as `target(config, profile, topics)` in the
    robot module, in a separate process.
    """


@hookspec
def roboneuron_locators() -> Sequence[LocatorSpec]:  # type: ignore[empty-body]
    """Offer finders of objects: calibrated pictures to places in the base frame.

    `target` follows the protocol `Locator`; it is built as `target(config)` in the server.
    `[sight] locator` of the configuration names the one in use.
    """


@hookspec
def roboneuron_features() -> Sequence[FeatureSpec]:  # type: ignore[empty-body]
    """Offer extensions of the server beyond starting, monitoring, limiting and stopping modules.

    `target` is a subclass of `roboneuron.server.feature.Feature`; it is built as `target(options)`
    in the server's process. Its tools and resources are collected before clients are served; it is
    started once the server has joined ROS. Every installed feature is used unless the configuration
    disables its distribution.
    """


@hookspec
def roboneuron_commands() -> Sequence[CommandSpec]:  # type: ignore[empty-body]
    """Offer commands of `roboneuron`.

    `target` is a class without arguments that follows the protocol
    `roboneuron.cli.listing.CommandModule`: `configure` adds its arguments to a parser, `run`
    returns the exit status. It is imported only when the command is used.
    """


HOOKS: Mapping[str, type[Spec]] = {
    f"{PROJECT}_{kind}s": spec for kind, spec in PLUGIN_KINDS.items()
}
"""Descriptor class by hook, for core's hooks, in the order of their calls."""


def extended(hooks: Mapping[str, type[Spec]], offered: Iterable[Spec]) -> Mapping[str, type[Spec]]:
    """Return `hooks` with those that these features and commands add.

    Raises:
        PluginError, MissingDependencyError: the class named by `brings` cannot be imported, is not
            a descriptor class, has an existing kind, or has no specification of its hook in its
            module.
    """
    found = dict(hooks)
    for bringer in offered:
        if not isinstance(bringer, (FeatureSpec, CommandSpec)) or bringer.brings is None:
            continue
        who = f"`brings` of {bringer.kind} {bringer.name!r}"
        brought = load_attribute(bringer.brings, who)
        for spec in (brought, *getattr(brought, "beside", ())):
            if not (
                isinstance(spec, type)
                and issubclass(spec, Spec)
                and NAME_PATTERN.fullmatch(spec.kind) is not None
            ):
                raise PluginError(
                    f"The {who} is {spec!r}, expected a descriptor class with a `kind`."
                )
            hook = f"{PROJECT}_{spec.kind.replace('-', '_')}s"
            if hook in found:
                raise PluginError(f"The {who} is of the hook {hook}, which is there already.")
            module = sys.modules[bringer.brings.partition(":")[0]]
            if not callable(getattr(module, hook, None)):
                raise PluginError(
                    f"The {who} is of the hook {hook}, which {module.__name__} lacks."
                )
            found[hook] = spec
    return found
