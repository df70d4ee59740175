"""Tightening of a robot profile's limits by the configuration."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from roboneuron.contract import Endpoint, Obstacle
from roboneuron.errors import ConfigurationError


@dataclass(frozen=True, kw_only=True, slots=True)
class ConfiguredLimits:
    """Configured limits of an endpoint, in addition to the robot's profile.

    Attributes:
        bounds: field path -> (lowest, highest), within the profile's.
        rate_hz: most messages per second, not above the profile's; None keeps it.
        frame: frame of places; that of the profile, if it has one.
        zones: boxes in that frame that must not contain a place, in addition to the profile's.
        clamp: field paths to clamp instead of refuse; each needs a bound.
    """

    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    rate_hz: float | None = None
    frame: str = ""
    zones: tuple[Obstacle, ...] = ()
    clamp: frozenset[str] = frozenset()


def tighten(endpoint: Endpoint, limits: ConfiguredLimits) -> Endpoint:
    """Return the endpoint with the configured limits.

    Raises:
        ConfigurationError: a limit is wider than the profile's, or a path to clamp has no bound.
    """
    bounds = dict(endpoint.bounds)
    for path, (low, high) in limits.bounds.items():
        lowest, highest = endpoint.bounds.get(path, (-math.inf, math.inf))
        if not lowest <= low <= high <= highest:
            raise ConfigurationError(
                f"Endpoint {endpoint.name!r}: {path} = [{low:g}, {high:g}] is not a range within "
                "the robot's "
                f"[{lowest:g}, {highest:g}]; limits can only be tightened."
            )
        bounds[path] = (low, high)
    for path in sorted(limits.clamp - set(bounds)):
        raise ConfigurationError(
            f"Endpoint {endpoint.name!r}: {path} is to be clamped, but nothing bounds it."
        )
    rate_hz = endpoint.rate_hz if limits.rate_hz is None else limits.rate_hz
    if endpoint.rate_hz and not 0.0 < rate_hz <= endpoint.rate_hz:
        raise ConfigurationError(
            f"Endpoint {endpoint.name!r}: rate_hz = {rate_hz:g} is above the robot's "
            f"{endpoint.rate_hz:g}."
        )
    if endpoint.frame and limits.frame not in ("", endpoint.frame):
        raise ConfigurationError(
            f"Endpoint {endpoint.name!r}: frame = {limits.frame!r}, the robot's limits of place "
            f"are in {endpoint.frame!r}."
        )
    return replace(
        endpoint,
        bounds=bounds,
        rate_hz=rate_hz,
        frame=endpoint.frame or limits.frame,
        zones=(*endpoint.zones, *limits.zones),
    )
