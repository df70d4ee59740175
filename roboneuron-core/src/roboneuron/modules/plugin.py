"""Construction of plugin objects inside a module process."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import cast

import numpy as np

from roboneuron.config.cameras import CameraConfig
from roboneuron.config.models import RobotConfig
from roboneuron.contract import CameraCalibration, CameraProfile, Pose, RobotProfile
from roboneuron.errors import ConfigurationError, PluginError
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


def load_profile(registry: Registry, robot: RobotConfig | str) -> RobotProfile:
    """Return the profile of a robot.

    Args:
        registry: the installed plugins.
        robot: the section `[robot]`, whose calibration of cameras replaces the profile's; or a
            robot's name, for its profile as the plugin has it.

    Raises:
        ConfigurationError: neither an installed plugin nor the configuration has it, what the
            configuration declares is refused, or the section calibrates a camera that it lacks, on
            an arm that it lacks, or without intrinsics.
        PluginError: its target returns another type.
    """
    name = robot if isinstance(robot, str) else robot.name
    spec = registry.get(RobotSpec, name)
    arguments = () if spec.declaration is None else (spec.declaration,)
    profile = cast("Callable[..., object]", load_target(spec))(*arguments)
    if not isinstance(profile, RobotProfile):
        raise PluginError(
            f"The target of robot {name!r} returned {type(profile).__name__}, expected "
            "RobotProfile."
        )
    measured = {} if isinstance(robot, str) else robot.cameras
    cameras = {camera.name: camera for camera in profile.cameras}
    for camera, section in measured.items():
        if camera not in cameras:
            raise ConfigurationError(
                f"[robot.cameras.{camera}]: robot {name!r} has no such camera; its cameras are "
                f"{', '.join(cameras) or 'none'}."
            )
        cameras[camera] = _calibrated(cameras[camera], section, profile)
    return replace(profile, cameras=tuple(cameras.values())) if measured else profile


def _calibrated(
    camera: CameraProfile, section: CameraConfig, profile: RobotProfile
) -> CameraProfile:
    """The camera with the calibration of its section. Raises ConfigurationError."""
    where = f"[robot.cameras.{camera.name}]"
    others = [f"{arm.name}/tcp" for arm in profile.arms[1:]]
    mounts = ["base", "tcp", *others] if profile.tcp_link else ["base"]
    if section.mount not in mounts:
        raise ConfigurationError(
            f"{where}: robot {profile.name!r} has no mount {section.mount!r}; it has "
            f"{', '.join(mounts)}."
        )
    width, height = section.size or (camera.width, camera.height)
    known = None if camera.calibration is None else camera.calibration.intrinsics
    if section.intrinsics is not None:
        fx, fy, cx, cy = section.intrinsics
        known = np.array([[fx, 0.0, cx + 0.5], [0.0, fy, cy + 0.5], [0.0, 0.0, 1.0]])
    if known is None:
        raise ConfigurationError(
            f"{where} has no intrinsics, and the profile of robot {profile.name!r} has none.",
            hint="Give size and intrinsics.",
        )
    pose = Pose(
        position_m=np.array(section.position_m),
        quaternion_xyzw=np.array(section.quaternion_xyzw) / np.linalg.norm(section.quaternion_xyzw),
    )
    calibration = CameraCalibration(
        intrinsics=known, mount=section.mount, T_mount_camera=pose.matrix
    )
    return replace(camera, width=width, height=height, calibration=calibration)
