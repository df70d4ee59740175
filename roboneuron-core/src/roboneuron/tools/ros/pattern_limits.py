"""Limits that patterns of the configuration set on the numbers of a type."""

from __future__ import annotations

import fnmatch
from collections.abc import Iterable
from dataclasses import replace

from roboneuron.contract import Endpoint
from roboneuron.direct_path.exposed import tightened_by
from roboneuron.tools.ros.exposed_types import number_fields
from roboneuron.tools.ros.options import DiscoverConfig

OTHERS = "*"
"""Key in a pattern's limits for all numbers of a type that are not named."""


def pattern_limits(endpoint: Endpoint, topic: str, patterns: Iterable[DiscoverConfig]) -> Endpoint:
    """Return the endpoint with the limits that configured patterns set for its type on topics like
    this one.
    """
    for entry in patterns:
        own = entry.limits.get(endpoint.type, {})
        if (
            not own
            or endpoint.kind not in entry.kinds
            or not fnmatch.fnmatchcase(topic, entry.pattern)
        ):
            continue
        spans = {path: (low, high) for path, (low, high) in own.items() if path != OTHERS}
        if OTHERS in own:
            low, high = own[OTHERS]
            spans |= {path: (low, high) for path in number_fields(endpoint) if path not in spans}
        endpoint = tightened_by(
            endpoint, replace(endpoint, bounds=spans, rate_hz=entry.rate_hz or 0.0)
        )
    return endpoint
