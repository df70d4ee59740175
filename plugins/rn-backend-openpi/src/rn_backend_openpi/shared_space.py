"""Control space of a shared model's chunks, determined without its server."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import cast

from pydantic import ValidationError

from rn_backend_openpi.shared_options import ModelOptions, SharedOptions, SpaceOptions
from roboneuron import (
    EE_DELTA,
    BackendSpec,
    ConfigurationError,
    ControlSpace,
    InvalidInputError,
    RobotProfile,
    robot_space,
)
from roboneuron.command import discover, loading


def shared_space(options: Mapping[str, object], profile: RobotProfile) -> ControlSpace | None:
    """The control space declared by the model's backend; for a model with an address that of the
    option `space`, or None, and then its server gives it after connecting.

    A backend that is installed only in the servers' interpreter is assumed to move the TCP; chunks
    in another space are then refused. Invalid options are reported when the backend loads.

    Raises:
        RoboNeuronError: as that backend's `space`.
    """
    try:
        given = SharedOptions.model_validate(dict(options))
    except ValidationError:
        return EE_DELTA
    if given.space is not None:
        return _declared(given.space, profile)
    if given.backend is None:
        return None
    try:
        spec = discover().get(BackendSpec, given.backend, elsewhere=True)
    except ConfigurationError:
        return EE_DELTA
    return space_of(spec, given, profile)


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
    # deltas have the same channels as positions
    kind = "joint_position" if options.kind == "joint_delta" else options.kind
    try:
        own = robot_space(kind, profile, options.rate_hz)
    except InvalidInputError as error:
        raise ConfigurationError(f"plugins.shared.space does not fit: {error.message}") from error
    known = {channel.key: channel for channel in own.channels}
    names = options.channels or tuple(known)
    unknown = [name for name in names if name not in known]
    if unknown or len(set(names)) != len(names):
        raise ConfigurationError(
            f"plugins.shared.space names {', '.join(unknown or names)}; each of the robot's "
            f"channels can appear once: {', '.join(known)}."
        )
    return ControlSpace(
        kind=options.kind,
        channels=tuple(known[name] for name in names),
        rate_hz=options.rate_hz,
    )
