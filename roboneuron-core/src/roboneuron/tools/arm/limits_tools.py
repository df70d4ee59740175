"""The tools tighten_limits and loosen_limits."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing
from typing import Any, Literal

import numpy as np
from pydantic import Field, ValidationError

from roboneuron.config import LimitsConfig
from roboneuron.contract import JointSample, Posture
from roboneuron.errors import InvalidInputError, RefusedError, RoboNeuronError
from roboneuron.gate.motion import MotionRules, inspector_of, motion_rules
from roboneuron.gate.motion.rules import beyond, faces
from roboneuron.gate.motion.task_space import TaskSpace
from roboneuron.gate.roles import Role
from roboneuron.server.host import Host
from roboneuron.server.tool import Arguments, CallContext, NoArguments, Result, Tool
from roboneuron.tools.arm.prediction import ArmControl
from roboneuron.tools.arm.tightening import Tightening

_TCP_ONLY = "For the TCP alone, the point between the fingertips (hand and arm may reach beyond): "
_WHOLE_ARM = "For the whole arm, and for what a closed hand may hold, 5 cm around the TCP: "
_MEASURED_S = 0.5
_TCP = "the TCP"


class TightenLimits(Arguments):
    """Arguments of tighten_limits."""

    max_speed_m_s: float | None = Field(default=None, gt=0, le=3, description="Of the TCP.")
    acceleration: float | None = Field(
        default=None, gt=0, le=1, description="Share of the joints' limits."
    )
    x_min_m: float | None = Field(
        default=None, description="The TCP stays in this box; y is left, z up."
    )
    x_max_m: float | None = None
    y_min_m: float | None = None
    y_max_m: float | None = None
    z_min_m: float | None = None
    z_max_m: float | None = None
    keep_out: list[float] | None = Field(
        default=None,
        min_length=6,
        max_length=6,
        description="Box to stay out of: x, y, z of two corners.",
    )
    applies_to: Literal["tcp", "arm"] = Field(
        default="tcp",
        description="arm: every link and what is held, at edges and keep_out.",
    )

    def tightening(self) -> Tightening:
        """Convert the arguments to limits; raises InvalidInputError if there are none."""
        given = self.model_dump(exclude_none=True, exclude={"applies_to"})
        if not given:
            raise InvalidInputError(
                "The call tightens nothing.", hint="Give a speed, an edge of the box, or keep_out."
            )
        if self.keep_out is not None:
            first, second = self.keep_out[:3], self.keep_out[3:]
            corners = {
                "lower_m": list(map(min, first, second)),
                "upper_m": list(map(max, first, second)),
            }
            given["keep_out"] = [corners]
        if self.applies_to == "arm":
            given["arm_keep_out"] = [*given.pop("keep_out", []), *self._faces(given)]
        try:
            return Tightening.model_validate(given)
        except ValidationError as error:
            problem = error.errors(include_url=False)[0]
            raise InvalidInputError(f"{problem['loc'][0]}: {problem['msg']}.") from error

    @staticmethod
    def _faces(given: dict[str, Any]) -> Iterator[dict[str, list[float]]]:
        """Take out the edges of the box; yield the space beyond each."""
        for number, axis in enumerate("xyz"):
            for end, relation in (("min", ">="), ("max", "<=")):
                edge_m = given.pop(f"{axis}_{end}_m", None)
                if edge_m is not None:
                    box = beyond(number, relation, edge_m)
                    yield {"lower_m": box.lower_m.tolist(), "upper_m": box.upper_m.tolist()}


class LimitsResult(Result):
    """The limits in force."""

    max_speed_m_s: float
    acceleration: float
    lower_m: list[float] | None = Field(description="corner of the TCP's box; null: none")
    upper_m: list[float] | None
    keep_out: dict[str, list[list[float]]] = Field(description="boxes by name")
    is_tightened: bool
    sticks_out: dict[str, dict[str, float]] = Field(
        description='"now" and "home" -> part and face: how far beyond [m]'
    )
    note: str = Field(description="what they hold for, and what is outside of them")


def limits_tools(
    host: Host, tighten: Callable[[Tightening, str, str], None], loosen: Callable[[str, str], None]
) -> list[Tool]:
    """Create both tools; see `LimitsFeature.tighten` and `loosen`."""

    def answer() -> LimitsResult:
        limits = host.loop.limits
        note, sticks_out = _note(host, limits), {}
        try:
            sticks_out = sticking_out(host, limits)
        except RefusedError as error:
            note = f"{note} {error}".strip()
        return LimitsResult(
            max_speed_m_s=limits.max_speed_m_s,
            acceleration=limits.acceleration_fraction,
            lower_m=limits.workspace_lower_m,
            upper_m=limits.workspace_upper_m,
            keep_out={zone.name: [zone.lower_m, zone.upper_m] for zone in limits.zones},
            is_tightened=host.modules.tightened is not None,
            sticks_out=sticks_out,
            note=note,
        )

    async def tighten_limits(arguments: TightenLimits, context: CallContext) -> LimitsResult:
        more = arguments.tightening()
        if more.arm_keep_out:
            await context.run(lambda _: _check_inside(host, more))
        await context.run(lambda _: tighten(more, context.who, context.role))
        return answer()

    async def loosen_limits(_: NoArguments, context: CallContext) -> LimitsResult:
        who = context.who
        if (
            host.config.server.reset_emergency_stop == "person"
            and host.modules.tightened is not None
        ):
            await _ask(host, context)
            who = f"a person asked by {who}"
        if host.modules.tightened is not None:
            await context.run(lambda _: loosen(who, context.role))
        return answer()

    return [
        Tool(
            name="tighten_limits",
            title="Tighten the limits",
            description="Slow motion down, or keep it out of an area: of policies and tools, "
            "also after restarts. A person loosens limits (tool loosen_limits).",
            arguments=TightenLimits,
            result=LimitsResult,
            handler=tighten_limits,
            idempotent=True,
            open_world=True,
        ),
        Tool(
            name="loosen_limits",
            title="Loosen the limits",
            description="Return to the configured limits. A person decides, as for "
            "reset_emergency_stop.",
            arguments=NoArguments,
            result=LimitsResult,
            handler=loosen_limits,
            destructive=True,
            idempotent=True,
            open_world=True,
            listed=False,  # a person's decision; and every agent reads every byte of the list
            role=Role.ADMIN,
        ),
    ]


def _note(host: Host, limits: LimitsConfig) -> str:
    """What limits of place hold for."""
    whole = [zone.name for zone in limits.zones if zone.applies_to == "arm"]
    has_box = bool(limits.workspace_lower_m or limits.workspace_upper_m)
    told = []
    of_tcp = [zone.name for zone in limits.zones if zone.applies_to == "tcp"]
    if has_box and limits.applies_to == "tcp":
        of_tcp.insert(0, "the box lower_m, upper_m")
    if of_tcp:
        told += [f"{_TCP_ONLY}{', '.join(of_tcp)}."]
    if limits.applies_to == "arm":
        whole.insert(0, "the configured box and height")
    if whole:
        told.append(f"{_WHOLE_ARM}{', '.join(whole)}.")
    return " ".join(filter(None, told))


def sticking_out(host: Host, limits: LimitsConfig) -> dict[str, dict[str, float]]:
    """How far TCP and links are beyond the limits that hold for them [m], by posture and by part
    and face; only postures that are beyond one. Raises RefusedError if it cannot be told.
    """
    exposed = next((one for one in host.gate.exposed if one.profile is not None), None)
    profile = None if exposed is None else exposed.profile
    places = (limits.workspace_lower_m, limits.workspace_upper_m, limits.min_height_m)
    if exposed is None or profile is None or not (limits.zones or places.count(None) < 3):
        return {}
    rules = motion_rules(limits, profile)
    postures = {"now": host.gate.joints(exposed, _MEASURED_S)}
    if profile.home_rad is not None:
        postures["home"] = JointSample(names=profile.arm_joints, position=profile.home_rad)
    told: dict[str, dict[str, float]] = {}
    try:
        with closing(ArmControl.of(host, exposed)) as control:
            inspect = inspector_of(control.controller)
            for name, joints in postures.items():
                if joints is not None:
                    told[name] = _beyond(rules, inspect(joints))
    except RoboNeuronError as error:
        raise RefusedError(
            f"Whether the arm keeps to the limits cannot be judged here: {error.message}",
            hint="Tighten them for the TCP, without applies_to.",
            rule="kinematics",
        ) from error
    return {name: beyond for name, beyond in told.items() if beyond}


def _beyond(rules: MotionRules, posture: Posture) -> dict[str, float]:
    """How far parts of a posture are beyond limits [m], by part and face."""
    found = TaskSpace(rules).protrusions(posture)
    told = {f"{link}, {zone}": depth_m for (link, zone), (_, depth_m) in found.items()}
    edges = (box for _, box in faces(rules.lower_m, rules.upper_m, rules.min_height_m))
    for zone in (*edges, *rules.zones):
        for arm in posture.arms:
            place_m = arm.pose.position_m
            into_m = np.minimum(place_m - zone.lower_m, zone.upper_m - place_m).min()
            if into_m > 0.0:
                told[f"{_TCP}, {zone.name}"] = float(into_m)
    return {name: round(depth_m, 4) for name, depth_m in told.items()}


def _check_inside(host: Host, more: Tightening) -> None:
    """Raise RefusedError for limits of the whole arm that it is beyond now: it could only get out
    of them.
    """
    exposed = next((one for one in host.gate.exposed if one.profile is not None), None)
    if exposed is None or exposed.profile is None:
        return
    limits = more.applied(host.loop.limits, exposed.profile)
    now = sticking_out(host, limits).get("now", {})
    beyond_m = {where: depth_m for where, depth_m in now.items() if not where.startswith(_TCP)}
    if beyond_m:
        where, depth_m = max(beyond_m.items(), key=lambda pair: pair[1])
        raise RefusedError(
            f"The arm is beyond these limits now: {where} by {depth_m:.3f} m.",
            hint="Move it inside first, give it that room, or tighten for the TCP (applies_to).",
            rule="workspace",
        )


async def _ask(host: Host, context: CallContext) -> None:
    """Raise RefusedError unless a person agreed to loosen these particular limits."""
    base, now = (
        limits.model_dump(mode="json") for limits in (host.loop.base.limits, host.loop.limits)
    )
    tighter = ", ".join(f"{key} = {value}" for key, value in now.items() if value != base[key])
    agreed = await context.ask(
        f"The robot's limits were tightened: {tighter}. Return to the configured ones?"
    )
    if agreed:
        return
    why = "this client cannot ask one" if agreed is None else "the person did not agree"
    raise RefusedError(
        f"Only a person loosens the limits, and {why}. They stay.",
        hint="Ask a person to run, in a terminal on this machine: roboneuron robot limits --loosen "
        "--state "
        f"{host.state_directory}",
        rule="person",
    )
