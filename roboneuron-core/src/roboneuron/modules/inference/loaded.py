"""A policy loaded in a module's process, which answers observations in the space of the robot."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Protocol, cast, runtime_checkable

from roboneuron.config.models import Config
from roboneuron.contract import (
    ActionChunk,
    AnyRuntime,
    Backend,
    CameraProfile,
    ControlSpace,
    Observation,
    RobotProfile,
)
from roboneuron.errors import ConfigurationError, PlanningError, PluginError
from roboneuron.modules.inference.agreement import (
    SpaceAgreement,
    agree_with_control,
    declared_space,
)
from roboneuron.modules.inference.planning import ResolvedPolicy
from roboneuron.modules.plugin import build, load_profile
from roboneuron.modules.status import StatusWriter
from roboneuron.plugins.registry import Registry
from roboneuron.plugins.specs import BackendSpec


@runtime_checkable
class ServedElsewhere(Protocol):
    """A backend whose model may be on another machine, where its properties are known."""

    def served_spec(self, profile: RobotProfile) -> tuple[BackendSpec, ControlSpace] | None:
        """Return the properties of the server's model for this robot: a descriptor with its needs
        and chunks, and the space of its rows. None for a local model. Called after loading.

        Raises:
            RoboNeuronError: the server does not report them, or this robot cannot use the model.
        """


@dataclass(frozen=True, kw_only=True, slots=True)
class LoadedPolicy:
    """A backend with its runtime and the conversion of its rows.

    Attributes:
        policy: its descriptors, as reported by its model's server if there is one.
        backend, runtime: the backend, and its runtime or None.
        agreement: agreement on the space of its rows.
        load_s: time of loading [s].
    """

    policy: ResolvedPolicy
    backend: Backend
    runtime: AnyRuntime | None
    agreement: SpaceAgreement
    load_s: float

    @property
    def name(self) -> str:
        """Name of the backend."""
        return self.policy.backend.name

    def report(self, status: StatusWriter) -> None:
        """Report the loaded parts in the status."""
        runtime, acceleration = self.policy.runtime, self.policy.acceleration
        status.set_value("space", self.agreement.executed.label)
        status.set_value("load_s", self.load_s)
        status.set_value("backend", self.name)
        status.set_value("runtime", runtime.name if runtime else "")
        status.set_value("acceleration", acceleration.name if acceleration else "")

    def answer(self, observation: Observation) -> ActionChunk:
        """Return a chunk in the space that control executes.

        Args:
            observation: may contain images of more cameras than this policy uses; it gets its own
                only.

        Raises:
            RoboNeuronError: as `Backend.predict` and `SpaceAgreement.convert`.
        """
        mine = self.policy.cameras
        if observation.frames.keys() - mine.keys():
            frames = {role: frame for role, frame in observation.frames.items() if role in mine}
            observation = replace(observation, frames=frames)
        return self.agreement.convert(self.backend.predict(observation), observation.joints)


def load_policy(
    config: Config,
    registry: Registry,
    policy: ResolvedPolicy,
    options: Mapping[str, object],
    resources: ExitStack,
) -> LoadedPolicy:
    """Build the parts of a policy and load its backend, weights and warm-up included.

    Args:
        config: configuration of the module, with the options of runtime and acceleration.
        registry: the installed plugins.
        policy: the policy to load.
        options: options of the backend, with its checkpoint.
        resources: closes the backend.

    Raises:
        PlanningError: the space of its rows does not fit, see `agree`, or the robot lacks a camera
            that its model's server requires.
        ConfigurationError: that server reports another space than is declared here.
        RoboNeuronError: it cannot be built or loaded.
    """
    spec, robot = policy.backend, config.robot.name
    declared = declared_space(registry, spec, options, robot)
    if declared is not None:  # before anything heavy
        agree_with_control(registry, spec, declared, robot, config.control)
    parts = {
        part: None if chosen is None else build(chosen, config.options(chosen.name))
        for part, chosen in (("runtime", policy.runtime), ("acceleration", policy.acceleration))
    }
    backend = cast("Backend", build(spec, options, **parts))
    resources.callback(backend.close)
    started_s = time.monotonic()
    backend.load()
    load_s = time.monotonic() - started_s
    policy, space = _as_served(policy, backend, declared, load_profile(registry, robot))
    return LoadedPolicy(
        policy=policy,
        backend=backend,
        runtime=cast("AnyRuntime | None", parts["runtime"]),
        agreement=agree_with_control(registry, spec, space, robot, config.control),
        load_s=load_s,
    )


def _as_served(
    policy: ResolvedPolicy, backend: Backend, declared: ControlSpace | None, profile: RobotProfile
) -> tuple[ResolvedPolicy, ControlSpace]:
    """Return the policy and its space as reported by its model's server, or else as declared here.

    Raises:
        PlanningError, ConfigurationError: as `load_policy`.
        PluginError: neither declares the space.
    """
    name = policy.backend.name
    told = backend.served_spec(profile) if isinstance(backend, ServedElsewhere) else None
    if told is None:
        if declared is None:
            raise PluginError(f"Neither the `space` of {name!r} nor its server says a space.")
        return policy, declared
    served, space = told
    if declared is not None and declared != space:
        raise ConfigurationError(
            f"The server of the model says that it yields {space.label!r}, the options of "
            f"{name!r} say {declared.label!r}.",
            hint=f"Leave `space` out of [plugins.{name}]: the server is asked.",
        )
    absent = [role for role in served.cameras if role not in policy.cameras]
    if absent:
        has = ", ".join(f"{role} ({camera})" for role, camera in policy.cameras.items()) or "none"
        raise PlanningError(
            f"The model of the server needs a camera of role {', '.join(absent)}; of robot "
            f"{profile.name!r} backend {name!r} uses: {has}.",
            hint="Name one in `cameras` of [inference], or choose another model.",
        )
    return replace(policy, backend=served), space


def resolved_cameras(
    policies: Iterable[ResolvedPolicy], profile: RobotProfile
) -> dict[str, CameraProfile]:
    """Return the camera by role, for all roles of the policies. Raises ConfigurationError for a
    camera that the robot's descriptor names but its profile does not.
    """
    cameras: dict[str, CameraProfile] = {}
    for policy in policies:
        for role, name in policy.cameras.items():
            camera = profile.camera(name)
            if camera is None:
                raise ConfigurationError(
                    f"Robot {profile.name!r} has no camera {name!r} for the role {role!r}."
                )
            cameras[role] = camera
    return cameras
