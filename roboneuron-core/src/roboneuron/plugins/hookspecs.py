"""The six hooks. Each takes nothing, imports nothing heavy and returns a sequence of frozen descriptors.

A plugin is a distribution with an entry point in the group `roboneuron` that points at a module holding any of these
functions, decorated with `roboneuron.plugins.markers.hookimpl`.
"""

from __future__ import annotations

from collections.abc import Sequence

from roboneuron.plugins.markers import hookspec
from roboneuron.plugins.specs import (
    AccelerationSpec,
    BackendSpec,
    ControllerSpec,
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


HOOKS = {
    "backend": "roboneuron_backends",
    "runtime": "roboneuron_runtimes",
    "acceleration": "roboneuron_accelerations",
    "perception": "roboneuron_perceptions",
    "controller": "roboneuron_controllers",
    "robot": "roboneuron_robots",
}
"""Hook name by descriptor kind."""
