"""Control space of a configured policy's chunks, determined before anything is loaded."""

from __future__ import annotations

from collections.abc import Mapping

from pydantic import ValidationError

from rn_backend_lerobot.options import LeRobotOptions
from rn_backend_lerobot.wiring import wire
from roboneuron import GRIPPER, ConfigurationError, ControlSpace, RobotProfile


def lerobot_space(options: Mapping[str, object], profile: RobotProfile) -> ControlSpace:
    """The space of the action's numbers, as the options map them to the robot.

    Reads the checkpoint's JSON files and statistics; neither PyTorch nor LeRobot is imported.

    Raises:
        CheckpointError: the checkpoint is damaged, or refused.
        ConfigurationError: options and policy do not match, or the robot has no such joint or
            camera.
    """
    try:
        given = LeRobotOptions.model_validate(dict(options))
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        message = first["msg"].removeprefix("Value error, ")
        raise ConfigurationError(
            f"[plugins.lerobot]{f' {where}' if where else ''}: {message}.",
            hint=_joints_hint(profile),
        ) from error
    wiring = wire(given)
    roles, names = _cameras(profile)
    for image in wiring.images:
        role = wiring.roles[image.key]
        if role not in roles and (role or image.short not in (*roles, *names)):
            have = ", ".join(f"{c.name} (role {c.role})" for c in profile.cameras) or "no camera"
            raise ConfigurationError(
                f"The policy takes {image.key!r}, and robot {profile.name!r} has no camera for "
                f"it; it has: {have}.",
                hint=f'Say which one it is: [plugins.lerobot.cameras] "{image.key}" = "ROLE".',
            )
    if given.space.startswith("joint_"):
        _check_joints(wiring.space, profile)
    return wiring.space


def _cameras(profile: RobotProfile) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Roles and names of the robot's cameras."""
    return (
        tuple(camera.role for camera in profile.cameras),
        tuple(camera.name for camera in profile.cameras),
    )


def _check_joints(space: ControlSpace, profile: RobotProfile) -> None:
    joints = {joint for arm in profile.each_arm for joint in arm.joints}
    absent = [c.name for c in space.channels if c.name != GRIPPER and c.name not in joints]
    if absent:
        raise ConfigurationError(
            f"The policy's numbers are mapped to {', '.join(absent)}, which robot "
            f"{profile.name!r} does not have.",
            hint=_joints_hint(profile),
        )


def _joints_hint(profile: RobotProfile) -> str:
    joints = ", ".join(f'"{joint}"' for joint in profile.arm_joints)
    return f"Robot {profile.name!r} has, from base to tip: joints = [{joints}]"
