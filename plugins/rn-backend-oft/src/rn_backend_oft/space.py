"""Which control space the chunks of a configured OFT have, said before anything is loaded."""

from __future__ import annotations

from collections.abc import Mapping

from pydantic import TypeAdapter, ValidationError

from rn_backend_oft.config import OwnConstants
from rn_backend_oft.constants import CONSTANTS, Constants
from rn_backend_oft.joints import JointActions
from roboneuron import EE_DELTA, ConfigurationError, ControlSpace, RobotProfile


def oft_space(options: Mapping[str, object], profile: RobotProfile) -> ControlSpace:
    """The space of the platform that the option `constants` names.

    Options that do not name a platform of joints are checked when the backend loads.

    Raises:
        ConfigurationError: the option `joints` is missing or does not fit the policy or the robot.
    """
    constants = _constants(options)
    if constants is None or constants.state != "joints":
        return EE_DELTA
    robots = ", ".join(f'"{joint}"' for joint in profile.arm_joints)
    hint = f"Robot {profile.name!r} has, from base to tip: joints = [{robots}]"
    joints = options.get("joints")
    if not isinstance(joints, list | tuple) or not all(isinstance(j, str) for j in joints):
        raise ConfigurationError(
            "A checkpoint that acts on joints needs the option 'joints': the robot's joints in the "
            "policy's order.",
            hint=hint,
        )
    space = JointActions(constants=constants, joints=tuple(joints)).space
    absent = [joint for joint in joints if joint not in profile.arm_joints]
    if len(constants.arms) == 1 and absent:
        raise ConfigurationError(
            f"The option 'joints' names {', '.join(absent)}, which the arm of robot "
            f"{profile.name!r} does not have.",
            hint=hint,
        )
    return space


def _constants(options: Mapping[str, object]) -> Constants | None:
    name, own = options.get("constants"), options.get("own_constants")
    if name == "own" and own is not None:
        try:
            return TypeAdapter(OwnConstants).validate_python(own).constants()
        except ValidationError:
            return None
    return CONSTANTS.get(name) if isinstance(name, str) else None
