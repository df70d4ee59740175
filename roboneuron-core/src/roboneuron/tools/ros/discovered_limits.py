"""Limits of discovered endpoints: an endpoint with numbers is exposed only if all of them are
bounded.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

from roboneuron.direct_path.joint_messages import JOINT_TYPES
from roboneuron.direct_path.limits import check_endpoint
from roboneuron.errors import ConfigurationError
from roboneuron.server.motion_gate import ExposedEndpoint
from roboneuron.tools.ros.exposed_types import is_joint_limited, is_velocity_type, number_fields
from roboneuron.tools.ros.interfaces import load_interface
from roboneuron.tools.ros.options import DiscoverConfig
from roboneuron.tools.ros.pattern_limits import OTHERS
from roboneuron.tools.ros.tightening import ConfiguredLimits, tighten


def check_patterns(discover: Iterable[DiscoverConfig]) -> None:
    """Check the types in `[[discover]]` before any endpoint is discovered.

    Raises:
        ConfigurationError: a type does not exist, or a limit is not a range.
    """
    for entry in discover:
        for name in (*entry.limits, *entry.unlimited):
            full = load_interface(name).name
            if name != full:
                raise ConfigurationError(
                    f"[[discover]] {entry.pattern!r}: write the type in full, {full}."
                )
        for name, limits in entry.limits.items():
            for path, (low, high) in limits.items():
                if not low <= high or not (math.isfinite(low) and math.isfinite(high)):
                    raise ConfigurationError(
                        f"[[discover]] {entry.pattern!r}: {path} of {name} = [{low:g}, {high:g}] "
                        "is no range."
                    )


def limit(
    discovered: ExposedEndpoint, entry: DiscoverConfig, known: Iterable[ExposedEndpoint]
) -> ExposedEndpoint:
    """Give a discovered endpoint the limits of its robot, tightened by those of the pattern.

    Args:
        discovered: without limits, and with its robot's profile.
        entry: the pattern.
        known: endpoints exposed by name; the limits of one with the same robot, kind and type
            apply.

    Raises:
        ConfigurationError: a number that may be sent has no bound, or a limit does not fit the
            type.
    """
    bare = discovered.endpoint
    if bare.kind == "read":
        return discovered
    own = entry.limits.get(bare.type, {})
    lender = next((e for e in known if _lends(e, discovered)), None)
    if lender is not None:
        bare = replace(
            lender.endpoint, name=bare.name, topic=bare.topic, summary=bare.summary,
            rate_hz=_slower(bare.rate_hz, lender.endpoint.rate_hz),
        )  # fmt: skip
    elif is_joint_limited(bare.kind, bare.type, discovered.profile):
        bare = replace(bare, joint_limited=True)
    named = {path: (low, high) for path, (low, high) in own.items() if path != OTHERS}
    if OTHERS in own:
        low, high = own[OTHERS]
        named |= {
            path: (low, high) for path in number_fields(bare) if path not in {*named, *bare.bounds}
        }
    limited = tighten(bare, ConfiguredLimits(bounds=named))
    check_endpoint(limited)
    free = [path for path in number_fields(limited) if path not in limited.bounds]
    # fields beside a nested command are not
    is_bounded = limited.joint_limited and bare.type in JOINT_TYPES
    if free and lender is None and not is_bounded and bare.type not in entry.unlimited:
        listed = ", ".join(free[:6]) + (" ..." if len(free) > 6 else "")
        raise ConfigurationError(
            f"nothing limits {listed} of {bare.type}.",
            hint=f'Give [discover.limits."{bare.type}"] a range for each or for "{OTHERS}", or '
            "list it in `unlimited`.",
        )
    if is_velocity_type(limited.kind, limited.type) and not limited.stop_message:
        limited = replace(limited, stop_message="zero")
    return replace(
        discovered, endpoint=limited, clamp=lender.clamp if lender is not None else frozenset()
    )


def _lends(known: ExposedEndpoint, discovered: ExposedEndpoint) -> bool:
    same = (known.robot, known.endpoint.kind, known.endpoint.type) == (
        discovered.robot, discovered.endpoint.kind, discovered.endpoint.type,
    )  # fmt: skip
    return same and not known.hidden and bool(known.endpoint.bounds or known.endpoint.joint_limited)


def _slower(first_hz: float, second_hz: float) -> float:
    """The lower of two rates, where 0 means no limit."""
    return min(first_hz or math.inf, second_hz or math.inf) if first_hz or second_hz else 0.0
