"""Which control space the chunks of a shared model have, said before its server is asked."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import cast

from pydantic import ValidationError

from rn_backend_shared.options import SharedOptions
from roboneuron import (
    EE_DELTA,
    BackendSpec,
    ConfigurationError,
    ControlSpace,
    RobotProfile,
)
from roboneuron.command import discover, loading


def shared_space(options: Mapping[str, object], profile: RobotProfile) -> ControlSpace:
    """What the backend that holds the model says of its own options.

    A backend that is installed in the server's interpreter only is taken to move the TCP; chunks
    in another space are then refused. Options that are wrong are told when the backend loads.

    Raises:
        RoboNeuronError: as that backend's `space`.
    """
    try:
        given = SharedOptions.model_validate(dict(options))
        if given.backend is None:
            return EE_DELTA
        spec = discover().get(BackendSpec, given.backend, elsewhere=True)
    except (ValidationError, ConfigurationError):
        return EE_DELTA
    if spec.space is None:
        return EE_DELTA
    own = dict(given.options)
    if given.checkpoint is not None:
        own["checkpoint"] = given.checkpoint
    declare = cast(
        "Callable[[Mapping[str, object], RobotProfile], ControlSpace]",
        loading.load_attribute(spec.space, f"`space` of {spec.name!r}"),
    )
    return declare(own, profile)
