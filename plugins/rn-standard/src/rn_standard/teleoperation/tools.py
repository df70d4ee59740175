"""Tools lead_arm and hand_back."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Literal

from pydantic import Field

from roboneuron import Arguments, CallContext, NoArguments, Result, Tool


class LeadArm(Arguments):
    """Arguments of lead_arm."""

    source: str = Field(description="Teleoperator that the person uses.")
    mode: Literal["person", "blend"] = Field(
        default="person",
        description="The policy waits, or the person's correction is added to its actions.",
    )
    scale: float = Field(default=1.0, gt=0, le=1, description="Factor of the speeds.")


class LeadResult(Result):
    """State of the lead."""

    leads: str = Field(default="", description="client that leads; empty for none")
    source: str = ""
    mode: str = ""
    policy: str = Field(default="", description="instruction that goes on after the hand-back")


Begin = Callable[[LeadArm, CallContext, threading.Event], LeadResult]
End = Callable[[CallContext], LeadResult]


def lead_tools(begin: Begin, end: End, choices: Callable[[], dict[str, str]]) -> list[Tool]:
    """Create both tools.

    Args:
        begin: starts a lead, which ends when the event is set; blocks.
        end: hands back; blocks.
        choices: returns teleoperators by name, with their summaries.
    """

    async def lead_arm(arguments: LeadArm, context: CallContext) -> LeadResult:
        halt = threading.Event()
        return await context.run(lambda stage: begin(arguments, context, halt), on_cancel=halt.set)

    async def hand_back(_: NoArguments, context: CallContext) -> LeadResult:
        return await context.run(lambda stage: end(context))

    return [
        Tool(
            name="lead_arm",
            title="Lead the arm by hand",
            description=(
                "A person leads the arm, or takes over from the policy, until hand_back. Control "
                "keeps the limits; releasing the switch, or silence, brakes the arm."
            ),
            arguments=LeadArm,
            result=LeadResult,
            handler=lead_arm,
            open_world=True,
            listed=False,
            choices={"source": choices},
        ),
        Tool(
            name="hand_back",
            title="Hand the arm back",
            description="End the lead; the policy goes on from where the arm is.",
            arguments=NoArguments,
            result=LeadResult,
            handler=hand_back,
            open_world=True,
            listed=False,
        ),
    ]
