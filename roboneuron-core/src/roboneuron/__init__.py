"""RoboNeuron: typed MCP tools and supervised closed loops between LLM agents, ROS 2 robots and VLA models.

What stands in `__all__` is the public API: all that a plugin needs of core. It is imported when it is first asked for,
so that a plugin module, which imports descriptors only, stays light. CHANGELOG.md records every change to it.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

# fmt: off
# ruff: noqa: I001
if TYPE_CHECKING:
    from roboneuron.config.section import Section
    from roboneuron.contract import (
        ACTION_FIELDS, ACTION_LABEL, ACTION_SIZE, Acceleration, Action, ActionChunk, Ahead, AnyAcceleration, AnyRuntime,
        Backend, CameraCalibration, CameraProfile, CollisionProfile, Controller, Endpoint, Frame, GripperProfile, Hold,
        JointCommand, JointLimits, JointSample, Observation, Obstacle, PerceptionSource, Pose, Posture,
        PostureInspector, Proximity, RobotDriver, RobotProfile, RobotState, Runtime, TWIST_FIELDS, Topics, Workspace,
        apply_delta, check_action_vector, check_rgb8, check_twist, frame_from_buffer,
    )
    from roboneuron.contract.rotation import (
        matrix_from_quaternion, matrix_from_rotvec, quaternion_from_matrix, rotvec_from_matrix,
    )
    from roboneuron.errors import (
        CheckpointError, ConfigurationError, InternalError, InvalidInputError, MissingDependencyError, NotReadyError,
        PlanningError, PluginError, RefusedError, RoboNeuronError, StateError, UngroundedError, UnsafeError,
    )
    from roboneuron.plugins.markers import hookimpl, hookspec
    from roboneuron.plugins.restricted import AgentMaySet, ConfigurationOnly
    from roboneuron.plugins.specs import (
        AccelerationSpec, ActionSpace, BackendSpec, CONTRACT_VERSION, CameraSpec, CommandSpec, ControllerSpec,
        DriverSpec, FeatureSpec, PerceptionSpec, Requirement, RobotSpec, RuntimeSpec, Spec,
    )
    from roboneuron.server.feature import Feature, Resource
    from roboneuron.server.host import Host
    from roboneuron.server.tool import Arguments, CallContext, NoArguments, Picture, Reply, Result, Tool

__version__ = "0.1.0"

_PLACES = {
    "roboneuron.config.section": (
        "Section",
    ),
    "roboneuron.contract": (
        "ACTION_FIELDS", "ACTION_LABEL", "ACTION_SIZE", "Acceleration", "Action", "ActionChunk", "Ahead",
        "AnyAcceleration", "AnyRuntime", "Backend", "CameraCalibration", "CameraProfile", "CollisionProfile",
        "Controller", "Endpoint", "Frame", "GripperProfile", "Hold", "JointCommand", "JointLimits", "JointSample",
        "Observation", "Obstacle",
        "PerceptionSource", "Pose", "Posture", "PostureInspector", "Proximity", "RobotDriver", "RobotProfile",
        "RobotState", "Runtime", "TWIST_FIELDS", "Topics", "Workspace", "apply_delta", "check_action_vector",
        "check_rgb8", "check_twist", "frame_from_buffer",
    ),
    "roboneuron.contract.rotation": (
        "matrix_from_quaternion", "matrix_from_rotvec", "quaternion_from_matrix", "rotvec_from_matrix",
    ),
    "roboneuron.errors": (
        "CheckpointError", "ConfigurationError", "InternalError", "InvalidInputError", "MissingDependencyError",
        "NotReadyError", "PlanningError", "PluginError", "RefusedError", "RoboNeuronError", "StateError",
        "UngroundedError", "UnsafeError",
    ),
    "roboneuron.plugins.markers": (
        "hookimpl", "hookspec",
    ),
    "roboneuron.plugins.restricted": (
        "AgentMaySet", "ConfigurationOnly",
    ),
    "roboneuron.plugins.specs": (
        "AccelerationSpec", "ActionSpace", "BackendSpec", "CONTRACT_VERSION", "CameraSpec", "CommandSpec",
        "ControllerSpec", "DriverSpec", "FeatureSpec", "PerceptionSpec", "Requirement", "RobotSpec", "RuntimeSpec",
        "Spec",
    ),
    "roboneuron.server.feature": (
        "Feature", "Resource",
    ),
    "roboneuron.server.host": (
        "Host",
    ),
    "roboneuron.server.tool": (
        "Arguments", "CallContext", "NoArguments", "Picture", "Reply", "Result", "Tool",
    ),
}
"""Public names by the module that defines them."""

__all__ = [  # noqa: RUF022
    "__version__",
    "Section",
    "ACTION_FIELDS", "ACTION_LABEL", "ACTION_SIZE", "Acceleration", "Action", "ActionChunk", "Ahead", "AnyAcceleration",
    "AnyRuntime", "Backend", "CameraCalibration", "CameraProfile", "CollisionProfile", "Controller", "Endpoint",
    "Frame", "GripperProfile", "Hold", "JointCommand", "JointLimits", "JointSample", "Observation", "Obstacle",
    "PerceptionSource", "Pose", "Posture", "PostureInspector", "Proximity", "RobotDriver", "RobotProfile", "RobotState",
    "Runtime", "TWIST_FIELDS", "Topics", "Workspace", "apply_delta", "check_action_vector", "check_rgb8", "check_twist",
    "frame_from_buffer",
    "matrix_from_quaternion", "matrix_from_rotvec", "quaternion_from_matrix", "rotvec_from_matrix",
    "CheckpointError", "ConfigurationError", "InternalError", "InvalidInputError", "MissingDependencyError",
    "NotReadyError", "PlanningError", "PluginError", "RefusedError", "RoboNeuronError", "StateError",
    "UngroundedError", "UnsafeError",
    "hookimpl", "hookspec",
    "AgentMaySet", "ConfigurationOnly",
    "AccelerationSpec", "ActionSpace", "BackendSpec", "CONTRACT_VERSION", "CameraSpec", "CommandSpec",
    "ControllerSpec", "DriverSpec", "FeatureSpec", "PerceptionSpec", "Requirement", "RobotSpec", "RuntimeSpec",
    "Spec",
    "Feature", "Resource",
    "Host",
    "Arguments", "CallContext", "NoArguments", "Picture", "Reply", "Result", "Tool",
]
# fmt: on


def __getattr__(name: str) -> object:
    """A public name, imported when it is first asked for."""
    for module, names in _PLACES.items():
        if name in names:
            value: object = getattr(import_module(module), name)
            globals()[name] = value
            return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
