"""Control space of a configured OFT's chunks, determined before anything is loaded."""

from __future__ import annotations

from collections.abc import Mapping

from pydantic import TypeAdapter, ValidationError

from rn_backend_oft.config import OwnConstants
from rn_backend_oft.constants import CONSTANTS, Constants
from rn_vla.joint_rows import declare_joints
from roboneuron import EE_DELTA, ControlSpace, RobotProfile


def oft_space(options: Mapping[str, object], profile: RobotProfile) -> ControlSpace:
    """The space of the platform that the option `constants` names.

    Options of platforms without joint actions are checked when the backend loads.

    Raises:
        ConfigurationError: the option `joints` is missing or does not match the policy or the
            robot.
    """
    constants = _constants(options)
    if constants is None or constants.state != "joints":
        return EE_DELTA
    return declare_joints(
        constants.rows(), options, profile, policy="A checkpoint that acts on joints"
    )


def _constants(options: Mapping[str, object]) -> Constants | None:
    name, own = options.get("constants"), options.get("own_constants")
    if name == "own" and own is not None:
        try:
            return TypeAdapter(OwnConstants).validate_python(own).constants()
        except ValidationError:
            return None
    return CONSTANTS.get(name) if isinstance(name, str) else None
