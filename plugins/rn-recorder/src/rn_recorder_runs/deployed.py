"""A backend built as in the server's inference module, in this process and without ROS."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, cast

from roboneuron import Backend, BackendSpec, CameraProfile, ConfigurationError, RobotProfile

if TYPE_CHECKING:
    from roboneuron.feature import Config
    from roboneuron.modules.inference.agreement import SpaceAgreement


@dataclass(frozen=True, kw_only=True)
class DeployedBackend:
    """A built backend that is not loaded.

    Attributes:
        spec: its descriptor.
        profile: of the robot.
        cameras: the robot's cameras by role.
        agreement: conversion of its rows for control.
    """

    backend: Backend
    spec: BackendSpec
    profile: RobotProfile
    cameras: Mapping[str, CameraProfile]
    agreement: SpaceAgreement


def build_backend(
    settings: Config,
    *,
    backend: str,
    robot: str,
    driver: str,
    checkpoint: str | None,
    runtime: str | None,
    acceleration: str | None,
    options: Mapping[str, Mapping[str, object]],
) -> DeployedBackend:
    """Build a backend with its runtime and acceleration, and agree on its space.

    Args:
        settings: provides options of plugins, cameras by role, and the controller.
        backend, robot, driver, runtime, acceleration: names.
        checkpoint: folder of the model's files; None for the options' value.
        options: by plugin; they override those of `settings`.

    Raises:
        ConfigurationError: options of a plugin that is not used here.
        RoboNeuronError: the backend does not fit the robot, or cannot be built.
    """
    from roboneuron.command import discover
    from roboneuron.feature import build, load_profile
    from roboneuron.modules.inference.agreement import SpaceAgreement
    from roboneuron.modules.inference.planning import ResolvedPolicy

    registry = discover(settings.disabled_plugins, settings.robot)
    policy = ResolvedPolicy.of(
        registry,
        robot=robot,
        driver=driver,
        backend=backend,
        runtime=runtime,
        acceleration=acceleration,
        cameras=dict(settings.inference.cameras) if settings.inference else {},
        is_driver_elsewhere=True,
    )
    made_of = [
        part.name
        for part in (policy.backend, policy.runtime, policy.acceleration)
        if part is not None
    ]
    for name in options:
        if name not in made_of:
            raise ConfigurationError(
                f"--option names {name!r}, which is not used here.",
                hint=f"Used are: {', '.join(made_of)}.",
            )

    def options_of(name: str) -> dict[str, object]:
        return {**settings.options(name), **options.get(name, {})}

    given = options_of(backend)
    if checkpoint is not None:
        given["checkpoint"] = str(Path(checkpoint).expanduser())
    profile = load_profile(registry, settings.robot if robot == settings.robot.name else robot)
    agreement = SpaceAgreement.of(registry, policy.backend, given, robot, settings.control)
    parts = {
        part: None if chosen is None else build(chosen, options_of(chosen.name))
        for part, chosen in (("runtime", policy.runtime), ("acceleration", policy.acceleration))
    }
    cameras = {
        role: camera
        for role, name in policy.cameras.items()
        if (camera := profile.camera(name)) is not None
    }
    return DeployedBackend(
        backend=cast("Backend", build(policy.backend, given, **parts)),
        spec=policy.backend,
        profile=profile,
        cameras=cameras,
        agreement=agreement,
    )
