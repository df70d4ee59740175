"""The hooks. Each takes nothing, imports nothing heavy and returns a sequence of frozen descriptors.

A plugin is a distribution with an entry point in the group `roboneuron` that points at a module holding any of these
functions, decorated with `roboneuron.plugins.markers.hookimpl`.
"""

from __future__ import annotations

from collections.abc import Sequence

from roboneuron.plugins.markers import hookspec
from roboneuron.plugins.specs import (
    AccelerationSpec,
    BackendSpec,
    CommandSpec,
    ControllerSpec,
    FeatureSpec,
    PerceptionSpec,
    RobotSpec,
    RuntimeSpec,
)


@hookspec
def roboneuron_backends() -> Sequence[BackendSpec]:  # type: ignore[empty-body]
    """Offer policies: image and instruction to actions.

    `target` follows the protocol `Backend`; it is built as `target(config, runtime=..., acceleration=...)` in the
    inference module, in a process of its own. The agent sees each as a choice of `start_inference`.
    """


@hookspec
def roboneuron_runtimes() -> Sequence[RuntimeSpec]:  # type: ignore[empty-body]
    """Offer engines that execute decoders for backends.

    `target` follows the protocol `Runtime`; it is built as `target(config)` in the inference module and handed to a
    backend whose `family` is among `families`.
    """


@hookspec
def roboneuron_accelerations() -> Sequence[AccelerationSpec]:  # type: ignore[empty-body]
    """Offer named presets that change how a loaded model is executed.

    `target` follows the protocol `Acceleration`; it is built as `target(config)` in the inference module and applied by
    a runtime that offers its `capability`.
    """


@hookspec
def roboneuron_perceptions() -> Sequence[PerceptionSpec]:  # type: ignore[empty-body]
    """Offer sources of camera frames.

    `target` follows the protocol `PerceptionSource`; it is built as `target(config, topics, cameras)` in the perception
    module, in a process of its own.
    """


@hookspec
def roboneuron_controllers() -> Sequence[ControllerSpec]:  # type: ignore[empty-body]
    """Offer controllers from actions to joint commands.

    `target` follows the protocol `Controller`; it is built as `target(config, profile)` in the control module, in a
    process of its own.
    """


@hookspec
def roboneuron_robots() -> Sequence[RobotSpec]:  # type: ignore[empty-body]
    """Offer robots.

    `target` is a function without arguments that returns the `RobotProfile`; each driver's `target` follows the
    protocol `RobotDriver` and is built as `target(config, profile, topics)` in the robot module, in a process of its
    own.
    """


@hookspec
def roboneuron_features() -> Sequence[FeatureSpec]:  # type: ignore[empty-body]
    """Offer what the server can do beyond starting, watching, limiting and stopping modules.

    `target` is a subclass of `roboneuron.server.feature.Feature`; it is built as `target(options)` in the server's
    process, asked for its tools and resources before clients are served, and started once the server has joined ROS.
    Every installed feature is used unless the configuration disables its distribution.
    """


@hookspec
def roboneuron_commands() -> Sequence[CommandSpec]:  # type: ignore[empty-body]
    """Offer commands of `roboneuron`.

    `target` is a class without arguments that follows the protocol `roboneuron.cli.commands.CommandModule`: `configure`
    adds its arguments to a parser, `run` returns the exit status. It is imported only when the command is used.
    """


HOOKS = {
    "backend": "roboneuron_backends",
    "runtime": "roboneuron_runtimes",
    "acceleration": "roboneuron_accelerations",
    "perception": "roboneuron_perceptions",
    "controller": "roboneuron_controllers",
    "robot": "roboneuron_robots",
    "feature": "roboneuron_features",
    "command": "roboneuron_commands",
}
"""Hook name by descriptor kind, of the hooks that core knows."""
