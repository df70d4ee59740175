"""The tools tighten_limits and loosen_limits."""

from __future__ import annotations

from collections.abc import Callable

from pydantic import Field, ValidationError

from rn_standard.tools_arm.tightening import Tightening
from roboneuron import (
    Arguments,
    CallContext,
    Host,
    InvalidInputError,
    NoArguments,
    RefusedError,
    Result,
    Tool,
)
from roboneuron.feature import Role


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
        description="Box that the TCP stays out of: x, y, z of two corners.",
    )

    def tightening(self) -> Tightening:
        """Convert the arguments to limits; raises InvalidInputError if there are none."""
        given = self.model_dump(exclude_none=True)
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
        try:
            return Tightening.model_validate(given)
        except ValidationError as error:
            problem = error.errors(include_url=False)[0]
            raise InvalidInputError(f"{problem['loc'][0]}: {problem['msg']}.") from error


class LimitsResult(Result):
    """The limits in force."""

    max_speed_m_s: float
    acceleration: float
    lower_m: list[float] | None = Field(description="corner of the TCP's box; null: none")
    upper_m: list[float] | None
    keep_out: dict[str, list[list[float]]] = Field(description="boxes by name")
    is_tightened: bool


def limits_tools(
    host: Host, tighten: Callable[[Tightening, str, str], None], loosen: Callable[[str, str], None]
) -> list[Tool]:
    """Create both tools; see `LimitsFeature.tighten` and `loosen`."""

    def answer() -> LimitsResult:
        limits = host.loop.limits
        return LimitsResult(
            max_speed_m_s=limits.max_speed_m_s,
            acceleration=limits.acceleration_fraction,
            lower_m=limits.workspace_lower_m,
            upper_m=limits.workspace_upper_m,
            keep_out={zone.name: [zone.lower_m, zone.upper_m] for zone in limits.zones},
            is_tightened=host.modules.tightened is not None,
        )

    async def tighten_limits(arguments: TightenLimits, context: CallContext) -> LimitsResult:
        more = arguments.tightening()
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
            "also after restarts. Limits can only be tightened; a person loosens them (tool "
            "loosen_limits).",
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
        hint="Ask a person to run, in a terminal on this machine: roboneuron limits --loosen "
        "--state "
        f"{host.state_directory}",
        rule="person",
    )
