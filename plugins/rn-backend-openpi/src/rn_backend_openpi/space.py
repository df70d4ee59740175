"""Control space of a configured policy server's chunks, determined without connecting."""

from __future__ import annotations

from collections.abc import Mapping

from pydantic import ValidationError

from rn_backend_openpi.interface import layout_of
from rn_backend_openpi.options import OpenpiOptions
from roboneuron import EE_DELTA, ConfigurationError, ControlSpace, RobotProfile


def openpi_space(options: Mapping[str, object], profile: RobotProfile) -> ControlSpace:
    """The space of the profile in the options. Invalid options are reported when the backend loads.

    Raises:
        ConfigurationError: the option `joints` is missing or does not match the policy or the
            robot.
    """
    known = OpenpiOptions.model_fields.keys() & options.keys()
    try:
        given = OpenpiOptions.model_validate({name: options[name] for name in known})
    except ValidationError:
        return EE_DELTA
    if given.profile is None:
        return EE_DELTA
    robots = ", ".join(f'"{joint}"' for joint in profile.arm_joints)
    hint = f"Robot {profile.name!r} has, from base to tip: joints = [{robots}]"
    try:
        space = layout_of(given).rows.space
    except ConfigurationError as error:
        raise ConfigurationError(error.message, hint=hint) from error
    absent = [joint for joint in given.joints or () if joint not in profile.arm_joints]
    if absent:
        raise ConfigurationError(
            f"The option 'joints' names {', '.join(absent)}, which robot {profile.name!r} does not "
            "have.",
            hint=hint,
        )
    return space
