"""Control space of a served policy's chunks, determined without connecting."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import cast

from pydantic import ValidationError

from rn_backend_openpi.interface import layout_of
from rn_backend_openpi.interface_options import SpaceOptions
from rn_backend_openpi.options import ModelOptions, PolicyOptions
from roboneuron import (
    EE_DELTA,
    BackendSpec,
    ConfigurationError,
    ControlSpace,
    InvalidInputError,
    RobotProfile,
    robot_space,
)
from roboneuron.command import discover
from roboneuron.feature import loading


def policy_space(options: Mapping[str, object], profile: RobotProfile) -> ControlSpace | None:
    """The control space of the profile in the options, of the option `space`, or of the backend on
    this machine; None for RoboNeuron's server elsewhere, which gives it after connecting.

    A backend that is installed only in the server's interpreter is assumed to move the TCP; chunks
    in another space are then refused. Invalid options are reported when the backend loads.

    Raises:
        ConfigurationError: `joints` or `space` do not match the policy or the robot.
        RoboNeuronError: as that backend's `space`.
    """
    try:
        given = PolicyOptions.model_validate(dict(options))
    except ValidationError:
        return EE_DELTA
    if given.profile is not None:
        return _of_profile(given, profile)
    if isinstance(given.space, SpaceOptions):
        return _declared(given.space, profile)
    if not given.is_local or given.backend is None:
        return None
    try:
        spec = discover().get(BackendSpec, given.backend, elsewhere=True)
    except ConfigurationError:
        return EE_DELTA
    return space_of(spec, given, profile)


def _of_profile(options: PolicyOptions, profile: RobotProfile) -> ControlSpace:
    robots = ", ".join(f'"{joint}"' for joint in profile.arm_joints)
    hint = f"Robot {profile.name!r} has, from base to tip: joints = [{robots}]"
    try:
        space = layout_of(options).rows.space
    except ConfigurationError as error:
        raise ConfigurationError(error.message, hint=hint) from error
    absent = [joint for joint in options.joints or () if joint not in profile.arm_joints]
    if absent:
        raise ConfigurationError(
            f"The option 'joints' names {', '.join(absent)}, which robot {profile.name!r} does not "
            "have.",
            hint=hint,
        )
    return space


def space_of(spec: BackendSpec, options: ModelOptions, profile: RobotProfile) -> ControlSpace:
    """The control space of a backend's chunks, with its options, on a robot.

    Raises:
        RoboNeuronError: as the backend's `space`.
    """
    if spec.space is None:
        return EE_DELTA
    own = dict(options.options)
    if options.checkpoint is not None:
        own["checkpoint"] = options.checkpoint
    declare = cast(
        "Callable[[Mapping[str, object], RobotProfile], ControlSpace]",
        loading.load_attribute(spec.space, f"`space` of {spec.name!r}"),
    )
    return declare(own, profile)


def _declared(options: SpaceOptions, profile: RobotProfile) -> ControlSpace:
    """The control space of the option `space`, with the units and frames of the robot.

    Raises:
        ConfigurationError: there is no such kind or channel.
    """
    if options.kind == EE_DELTA.kind and not options.channels:
        return EE_DELTA
    # deltas have the same channels as positions
    kind = "joint_position" if options.kind == "joint_delta" else options.kind
    try:
        own = robot_space(kind, profile, options.rate_hz)
    except InvalidInputError as error:
        raise ConfigurationError(f"The option space does not fit: {error.message}") from error
    known = {channel.key: channel for channel in own.channels}
    names = options.channels or tuple(known)
    unknown = [name for name in names if name not in known]
    if unknown or len(set(names)) != len(names):
        raise ConfigurationError(
            f"The option space names {', '.join(unknown or names)}; each of the robot's "
            f"channels can appear once: {', '.join(known)}."
        )
    return ControlSpace(
        kind=options.kind,
        channels=tuple(known[name] for name in names),
        rate_hz=options.rate_hz,
    )
