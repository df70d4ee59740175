"""A policy that is loaded in a module's process: what answers observations in the space of the
robot.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import cast

from rn_standard.inference.agreement import SpaceAgreement, agree_on_space
from rn_standard.inference.planning import Policy
from roboneuron import (
    ActionChunk,
    AnyRuntime,
    Backend,
    CameraProfile,
    ConfigurationError,
    Observation,
    RobotProfile,
)
from roboneuron.feature import Config, Registry
from roboneuron.node import StatusWriter, build


@dataclass(frozen=True, kw_only=True, slots=True)
class LoadedPolicy:
    """A backend with its runtime, and what becomes of its rows.

    Attributes:
        policy: its descriptors.
        backend, runtime: what predicts, and what executes it; None for a backend without runtime.
        agreement: on the space of its rows.
        load_s: how long it took to load.
    """

    policy: Policy
    backend: Backend
    runtime: AnyRuntime | None
    agreement: SpaceAgreement
    load_s: float

    @property
    def name(self) -> str:
        """Of the backend."""
        return self.policy.backend.name

    def report(self, status: StatusWriter) -> None:
        """What is loaded, for the status."""
        runtime, acceleration = self.policy.runtime, self.policy.acceleration
        status.set_value("space", self.agreement.executed.label)
        status.set_value("load_s", self.load_s)
        status.set_value("backend", self.name)
        status.set_value("runtime", runtime.name if runtime else "")
        status.set_value("acceleration", acceleration.name if acceleration else "")

    def answer(self, observation: Observation) -> ActionChunk:
        """A chunk in the space that control executes.

        Args:
            observation: may hold images of more cameras than this policy takes; it gets its own.

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
    policy: Policy,
    options: Mapping[str, object],
    resources: ExitStack,
) -> LoadedPolicy:
    """Build the parts of a policy and load its backend, weights and warm-up included.

    Args:
        config: of the module; the options of runtime and acceleration come from it.
        registry: what is installed.
        policy: what to load.
        options: of the backend, with its checkpoint.
        resources: gets what closes the backend.

    Raises:
        PlanningError: the space of its rows does not fit, see `agree_on_space`.
        RoboNeuronError: it cannot be built or loaded.
    """
    spec = policy.backend
    agreement = agree_on_space(registry, spec, options, config.robot.name, config.control)
    parts = {
        part: None if chosen is None else build(chosen, config.options(chosen.name))
        for part, chosen in (("runtime", policy.runtime), ("acceleration", policy.acceleration))
    }
    backend = cast("Backend", build(spec, options, **parts))
    resources.callback(backend.close)
    started_s = time.monotonic()
    backend.load()
    return LoadedPolicy(
        policy=policy,
        backend=backend,
        runtime=cast("AnyRuntime | None", parts["runtime"]),
        agreement=agreement,
        load_s=time.monotonic() - started_s,
    )


def resolved_cameras(policies: Iterable[Policy], profile: RobotProfile) -> dict[str, CameraProfile]:
    """Camera by role, for all that any of the policies takes. Raises ConfigurationError for one
    that the descriptor of the robot names and its profile does not.
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
