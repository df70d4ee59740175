"""Robots served by one tool, chosen by the `robot` argument if there are several."""

from __future__ import annotations

from collections.abc import Sequence

from pydantic.json_schema import JsonSchemaValue

from roboneuron.direct_path.delivery import TRAJECTORY
from roboneuron.server.motion_gate import ExposedEndpoint


class Targets:
    """Endpoints of the same label, kind and type, one per robot.

    Attributes:
        trajectory: a message contains its duration.
        lasting: a published value has a duration, after which it is stopped, during which it is
            repeated, or within which it has to be reached.
    """

    def __init__(self, endpoints: Sequence[ExposedEndpoint]) -> None:
        self.endpoints = tuple(endpoints)
        self._by_robot = {exposed.robot: exposed for exposed in endpoints}
        self.trajectory = self.first.endpoint.type == TRAJECTORY
        self.lasting = not self.trajectory and any(
            e.endpoint.stop_message or e.endpoint.repeat_hz or e.endpoint.joint_limited
            for e in self.endpoints
        )

    @property
    def first(self) -> ExposedEndpoint:
        """Any of them, for their common properties."""
        return self.endpoints[0]

    @property
    def arguments(self) -> list[str]:
        """Names of the choosing arguments: "robot" if there is a choice."""
        return ["robot"] if len(self.endpoints) > 1 else []

    def schema(self) -> dict[str, JsonSchemaValue]:
        """Schema properties of the choosing arguments."""
        if len(self.endpoints) == 1:
            return {}
        return {"robot": {"enum": list(self._by_robot)}}

    def of(self, robot: str) -> ExposedEndpoint:
        """Return the endpoint of a call; that of the only robot if there is one."""
        return self.endpoints[0] if len(self.endpoints) == 1 else self._by_robot[robot]

    def describe(self) -> str:
        """Describe each robot's endpoint: topic, limits, rate."""
        return " ".join(_describe(e, len(self.endpoints) > 1) for e in self.endpoints)


def _describe(exposed: ExposedEndpoint, named: bool) -> str:
    endpoint = exposed.endpoint
    parts = [
        f"{exposed.robot}: {endpoint.summary}" if named else endpoint.summary,
        f"On {exposed.topic}.",
    ]
    if endpoint.bounds:
        limits = [
            f"{path} {low:g} .. {high:g}"
            for path, (low, high) in endpoint.bounds.items()
            if low != high
        ]
        zeros = [path for path, (low, high) in endpoint.bounds.items() if low == high == 0]
        fixed = [
            f"{path} = {low:g}" for path, (low, high) in endpoint.bounds.items() if low == high != 0
        ]
        if limits or fixed:
            parts.append(f"Limits: {', '.join([*limits, *fixed])}.")
        if zeros:
            parts.append(f"Must be 0: {', '.join(zeros)}.")
    if endpoint.min_turning_radius_m:
        parts.append(f"Turning radius at least {endpoint.min_turning_radius_m:g} m.")
    if endpoint.frame:
        zones = ", ".join(zone.name for zone in endpoint.zones)
        parts.append(f"Places have to be in the frame {endpoint.frame!r}.")
        parts.append(f"They must not be in these zones: {zones}." if zones else "")
    if endpoint.joint_limited:
        parts.append("The robot's limits are enforced.")
    if endpoint.rate_hz:
        parts.append(f"At most {endpoint.rate_hz:g} per second.")
    if exposed.clamp:
        parts.append(f"Clamped to the limits: {', '.join(sorted(exposed.clamp))}.")
    return " ".join(part for part in parts if part)
