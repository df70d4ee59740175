"""LeRobot's robot for the driver: created from its own configuration, and checked before it is
connected. The only module that imports lerobot.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Mapping
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Protocol, cast

from rn_robot_lerobot.calibration import MotorCalibration, read_calibration
from rn_robot_lerobot.lerobot_options import LerobotDriverOptions, MotorOption
from rn_robot_lerobot.units import (
    SUFFIX,
    MotorMap,
    MotorUnit,
    degrees,
    percent,
    share_of_range,
)
from roboneuron import (
    ConfigurationError,
    GripperProfile,
    InvalidInputError,
    MissingDependencyError,
    NotReadyError,
    RobotProfile,
)

VERSIONS = ("0.6.1", "0.7")
"""Supported versions: from the first, before the second."""
_ATTEMPTS = 3
"""LeRobot sends about sixty requests without a retry when it connects, and a bus loses some
answers.
"""
_UNIT_BY_MODE = {"degrees": "degrees", "range_0_100": "percent", "range_m100_100": "range"}
"""The unit of the option for LeRobot's `MotorNormMode`."""


class LerobotRobot(Protocol):
    """The used part of lerobot's `Robot`."""

    name: str
    calibration_fpath: Path
    action_features: Mapping[str, object]
    is_calibrated: bool
    is_connected: bool

    def connect(self, calibrate: bool = True) -> None:
        """Open the bus."""

    def get_observation(self) -> Mapping[str, float]:
        """Read the measurements."""

    def send_action(self, action: dict[str, float]) -> Mapping[str, float]:
        """Send goals; return the goals really sent."""

    def disconnect(self) -> None:
        """Close the bus."""


def check_version(found: str | None) -> None:
    """Check that this driver supports a version of lerobot.

    Raises:
        MissingDependencyError: lerobot is not installed in this environment.
        ConfigurationError: the version is not supported.
    """
    first, end = VERSIONS
    wanted = f'"lerobot[feetech,dynamixel]>={first},<{end}"'
    hint = f"Run: pip install {wanted} in the environment of [robot]."
    if found is None:
        raise MissingDependencyError(
            "The driver 'lerobot' needs an environment with lerobot; this one has none.",
            hint=f"Name its interpreter: python = ... in [robot]. {hint}",
        )
    if not _numbers(first) <= _numbers(found) < _numbers(end):
        raise ConfigurationError(
            f"lerobot is {found}; the driver is written for {first} and newer, before {end}.",
            hint=hint,
        )


def _numbers(text: str) -> tuple[int, ...]:
    parts = text.split("+")[0].split(".")
    return tuple(int(part) for part in parts if part.isdecimal())


def make_robot(options: LerobotDriverOptions) -> LerobotRobot:
    """Create LeRobot's robot, not connected.

    Raises:
        MissingDependencyError, ConfigurationError: as `check_version`; the type is unknown, or a
            setting does not exist.
    """
    try:
        check_version(version("lerobot"))
    except PackageNotFoundError:
        check_version(None)
    from lerobot import robots  # heavy
    from lerobot.utils.import_utils import register_third_party_plugins  # heavy

    for module in pkgutil.iter_modules(robots.__path__):
        if module.ispkg:
            try:
                importlib.import_module(f"{robots.__name__}.{module.name}")
            except ImportError:  # a robot whose own packages are not installed
                continue
    register_third_party_plugins()
    known = robots.RobotConfig.get_known_choices()
    if options.type not in known:
        raise ConfigurationError(
            f"LeRobot has no robot {options.type!r}; it has {', '.join(sorted(known))}."
        )
    given: dict[str, object] = {"id": options.id, **options.settings}
    if options.port:
        given["port"] = options.port
    if options.calibration_dir:
        given["calibration_dir"] = Path(options.calibration_dir).expanduser()
    maker = known[options.type]
    fields = maker.__dataclass_fields__
    if "cameras" in fields:  # images come from perception; a LeKiwi has two by default
        given.setdefault("cameras", {})
    if "disable_torque_on_disconnect" in fields:
        given.setdefault("disable_torque_on_disconnect", options.release_on_close)
    unknown = [name for name in given if name not in fields]
    if unknown:
        raise ConfigurationError(
            f"LeRobot's {options.type!r} has no setting {unknown[0]!r}; it has "
            f"{', '.join(sorted(fields))}."
        )
    try:
        return cast(LerobotRobot, robots.make_robot_from_config(maker(**given)))
    except (TypeError, ImportError) as error:
        raise ConfigurationError(f"LeRobot's {options.type!r} cannot be made: {error}.") from error


def map_motors(
    robot: LerobotRobot,
    options: LerobotDriverOptions,
    profile: RobotProfile,
    calibration: Mapping[str, MotorCalibration],
) -> MotorMap:
    """Map each motor to a joint, by name.

    Raises:
        ConfigurationError: a motor moves no joint of the profile, or a joint has no motor; a unit
            differs from LeRobot's.
    """
    names = [key.removesuffix(SUFFIX) for key in robot.action_features if key.endswith(SUFFIX)]
    strangers = [name for name in options.motors if name not in names]
    if strangers:
        raise ConfigurationError(
            f"The option motors names {strangers[0]!r}; the robot has {', '.join(names)}."
        )
    grippers = {gripper.joint: gripper for gripper in profile.grippers}
    joints = (*profile.arm_joints, *grippers)
    units = []
    for name in names:
        option = options.motors.get(name, MotorOption())
        joint = option.joint or name.removeprefix(options.motor_prefix)
        if joint not in joints:
            raise ConfigurationError(
                f"Motor {name!r} moves the joint {joint!r}, which robot {profile.name!r} does not "
                f"have; it has {', '.join(joints)}.",
                hint=f"Say which one: motors.{name}.joint.",
            )
        told = _told_unit(robot, name)
        unit = option.unit or told or ("percent" if joint in grippers else "degrees")
        if told and told != unit:
            raise ConfigurationError(
                f"LeRobot yields motor {name!r} in {told}, the driver expects {unit}.",
                hint=f"Leave motors.{name}.unit out, or set use_degrees of the robot.",
            )
        units.append(_unit(name, joint, unit, option, grippers.get(joint), calibration.get(name)))
    try:
        motors = MotorMap(units)
    except InvalidInputError as error:
        raise ConfigurationError(error.message) from error
    still = [joint for joint in joints if joint not in motors.joints]
    if still:
        raise ConfigurationError(
            f"No motor of LeRobot's {options.type!r} moves the joint {still[0]!r}; its motors are "
            f"{', '.join(names)}."
        )
    return motors


def _told_unit(robot: LerobotRobot, name: str) -> str:
    """Unit that LeRobot reports for a motor; empty if it reports none."""
    motors = getattr(getattr(robot, "bus", None), "motors", {})
    if name not in motors:
        return ""
    mode = str(motors[name].norm_mode.value)
    return _UNIT_BY_MODE.get(mode, mode)


def _unit(
    name: str,
    joint: str,
    unit: str,
    option: MotorOption,
    gripper: GripperProfile | None,
    calibration: MotorCalibration | None,
) -> MotorUnit:
    sign = -1.0 if option.inverted else 1.0
    offset_rad = degrees(name, joint).scale * option.offset_deg
    if unit == "percent":
        if gripper is None:
            raise ConfigurationError(f"Motor {name!r} is in percent, and {joint!r} is no gripper.")
        closed, opened = gripper.closed_position, gripper.open_position
        return percent(name, joint, closed, opened, inverted=option.inverted)
    if unit == "range":
        if calibration is None:
            raise ConfigurationError(f"Motor {name!r} is in -100..100, and has no calibration.")
        half_rad = calibration.half_range_rad
        return share_of_range(name, joint, half_rad, sign=sign, offset_rad=offset_rad)
    if unit == "radians":
        return MotorUnit(motor=name, joint=joint, scale=sign, offset=offset_rad)
    return degrees(name, joint, sign=sign, offset_rad=offset_rad)


def calibration_of(
    robot: LerobotRobot, options: LerobotDriverOptions
) -> dict[str, MotorCalibration]:
    """Calibration from LeRobot's own file; empty for a robot without its own bus.

    Raises:
        ConfigurationError: as `read_calibration`.
    """
    motors = getattr(getattr(robot, "bus", None), "motors", None)
    if motors is None:
        return {}
    port = f" --robot.port={options.port}" if options.port else ""
    command = f"lerobot-calibrate --robot.type={options.type} --robot.id={options.id}{port}"
    return read_calibration(robot.calibration_fpath, tuple(motors), command)


def connect(robot: LerobotRobot, options: LerobotDriverOptions) -> None:
    """Open the bus; never starts a calibration, which would wait for a person.

    Raises:
        NotReadyError: the bus or a motor does not answer, even after retries.
        ConfigurationError: the motors contain another calibration than the file.
    """
    where = f" on {options.port}" if options.port else ""
    for attempt in range(1, _ATTEMPTS + 1):
        try:
            robot.connect(calibrate=False)
            is_calibrated = bool(robot.is_calibrated)
            break
        except (OSError, RuntimeError) as error:
            _drop(robot)
            if attempt < _ATTEMPTS:
                continue
            # lerobot hides a missing answer in the cause; the rest repeats the whole list of motors
            told = str(error.__cause__ or error).split("Full expected motor list")[0]
            words = " ".join(told.split())
            raise NotReadyError(
                f"LeRobot's {options.type!r}{where} does not answer: {words}",
                hint="Is it powered and plugged in, and does nothing else use the port?",
            ) from error
    if not is_calibrated:
        robot.disconnect()
        raise ConfigurationError(
            f"The motors{where} hold another calibration than {robot.calibration_fpath}.",
            hint=f"Run lerobot-calibrate --robot.type={options.type} --robot.id={options.id} and "
            "press Enter to write the file into the motors.",
        )


def _drop(robot: LerobotRobot) -> None:
    """Close a port whose bus does not answer."""
    with suppress(OSError, RuntimeError):
        if robot.is_connected:
            robot.disconnect()
