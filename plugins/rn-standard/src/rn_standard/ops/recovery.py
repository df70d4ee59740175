"""Tool recover_robot: a person releases an arm that a fault has stopped."""

from __future__ import annotations

import time
from collections.abc import Sequence

from pydantic import Field

from rn_standard.ops.recovery_parameter import RECOVER_PARAMETER
from roboneuron import (
    CallContext,
    Feature,
    Host,
    NoArguments,
    NotReadyError,
    RefusedError,
    Result,
    RobotSpec,
    StateError,
    Tool,
)
from roboneuron.feature import AuditRecord, Role

_SET_S = 5.0
_DONE_S = 20.0


class RecoveryResult(Result):
    """Result of a recovery."""

    recovered_from: str = Field(description="code of the fault that was cleared")
    took_s: float
    note: str


class RecoveryFeature(Feature[None]):
    """Adds recover_robot if the configured driver of the robot supports it."""

    def tools(self, host: Host) -> Sequence[Tool]:
        """See `Feature.tools`."""
        robot = host.registry.specs(RobotSpec).get(host.config.robot.name)
        driver = None if robot is None else robot.driver(host.config.robot.driver)
        return (_tool(host),) if driver is not None and driver.recovers else ()


def _tool(host: Host) -> Tool[NoArguments]:
    async def recover_robot(_: NoArguments, context: CallContext) -> RecoveryResult:
        who = context.who
        if host.config.server.reset_emergency_stop == "person":
            await _ask(context)
            who = f"a person asked by {who}"
        return await context.run(lambda _: _recover(host, who, context.role))

    return Tool(
        name="recover_robot",
        title="Recover the robot from a fault",
        description=(
            "Clear the fault that has stopped the arm (reflex, user stop, lost connection ...; "
            "see detail.fault in "
            "get_status). A person decides, after having looked at the arm: the client asks one, "
            "if it can. Refused "
            "while the cause stands. Nothing moves by itself afterwards: the policy has forgotten "
            "its instruction; "
            "set_instruction or run_task starts it again."
        ),
        arguments=NoArguments,
        result=RecoveryResult,
        handler=recover_robot,
        destructive=True,
        open_world=True,
        role=Role.OPERATOR,
    )


async def _ask(context: CallContext) -> None:
    agreed = await context.ask(
        "Recover the robot from its fault? Look at the arm first. Nothing moves until someone "
        "asks for it anew."
    )
    if agreed:
        return
    reason = "This client cannot ask a person." if agreed is None else "The person did not agree."
    raise RefusedError(
        f"The robot is not recovered. {reason}",
        hint='Use a client with elicitation, or set [server] reset_emergency_stop = "client".',
        rule="person",
    )


def _recover(host: Host, who: str, role: str) -> RecoveryResult:
    """Request the recovery from the robot module, and record its answer in the audit.

    Raises:
        RefusedError: the cause persists, or the audit cannot be written.
        StateError: there is no fault, or no robot runs.
        NotReadyError: no answer in time.
    """
    started_s = time.monotonic()
    host.modules.require_running("robot")

    def write(verdict: str, reason: str) -> None:
        host.audit.write(
            AuditRecord(
                who=who,
                role=role,
                tool="recover_robot",
                verdict=verdict,
                robot=host.config.robot.name,
                reason=reason,
            )
        )

    write("allowed", "asks the robot to recover")  # first: nothing is released without an audit
    # also if no fault was detected before
    host.loop.starts.stop("robot", "a recovery from a fault", is_asked=False)
    number = time.time_ns() // 1_000_000
    if refused := host.loop.set_parameters("robot", {RECOVER_PARAMETER: number}, _SET_S):
        raise StateError(f"The robot module refused: {refused}.")

    def answer() -> str | None:
        report = host.modules.require_running("robot").report
        told = report.metrics.get("recovery", "") if report is not None else ""
        return told.removeprefix(f"{number} ") if told.startswith(f"{number} ") else None

    told = host.modules.changes.wait_for(answer, _DONE_S)
    if told is None:
        raise NotReadyError(
            f"The robot did not say within {_DONE_S:g} s whether it recovered.",
            hint="See get_status.",
        )
    word, _, text = told.partition(" ")
    write("allowed" if word == "recovered" else "refused", told)
    if word == StateError.code:
        raise StateError(text)
    if word != "recovered":
        raise RefusedError(text, rule="person")
    return RecoveryResult(
        recovered_from=text,
        took_s=round(time.monotonic() - started_s, 3),
        note=host.loop.starts.AGAIN,
    )
