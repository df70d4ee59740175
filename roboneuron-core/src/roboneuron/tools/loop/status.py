"""Status of the whole server: get_status, and the same as an MCP resource."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Sequence
from dataclasses import asdict
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any, Protocol, runtime_checkable

from pydantic import Field

from roboneuron import __version__
from roboneuron.gate import StillReason
from roboneuron.server.host import Host
from roboneuron.server.loop import ClosedLoop
from roboneuron.server.tool import Arguments, CallContext, Resource, Tool
from roboneuron.supervisor.overload import overload
from roboneuron.tools.loop.results import ModuleStatus, ReasonResult, RobotStatus, StatusResult

STATUS_URI = "roboneuron://status"
_RECENT_S = 300.0


@cache
def _versions() -> dict[str, str]:
    """Versions of the packages that matter in a bug report."""
    found = {"roboneuron": __version__, "python": platform.python_version()}
    for package in ("mcp", "ros-jazzy-rclpy"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed as a package"
    return found


class GetStatus(Arguments):
    """Arguments of get_status."""

    details: bool = Field(default=False, description="Metrics and times too.")


def status(host: Host, asker: CallContext | None = None, *, details: bool = True) -> StatusResult:
    """Collect the status, for that client."""
    loop = host.loop
    omitted = host.features.omitted
    cause = loop.emergency_stop.cause()
    reasons = host.why_still(asker)
    known: dict[str, Any] = {
        "emergency_stop_cause": cause,
        "left_out": omitted,
        "why_still": [ReasonResult.of(reason) for reason in reasons],
    }
    robot = RobotStatus(**asdict(loop.robot_facts))
    if unchecked := loop.unchecked:
        robot = robot.model_copy(update={"unchecked": unchecked})
    modules = [ModuleStatus.of(view, details=details) for view in loop.modules.views()]
    if details:
        known["versions"] = _versions()
    return StatusResult(
        summary=summary(host, reasons),
        robot=robot,
        modules=modules,
        emergency_stop=loop.emergency_stop.is_latched(),
        **{name: value for name, value in known.items() if value},
        namespace=loop.config.namespace,
        tightened_limits=_tightened(loop),
        uptime_s=round(time.monotonic() - host.started_s, 1),
        pid=os.getpid(),
        log_directory=str(loop.modules.log_directory),
    )


@runtime_checkable
class CountsFaults(Protocol):
    """A feature that records faults of modules."""

    def recent_faults(self, within_s: float) -> tuple[int, list[str], float]:
        """Faults of the last seconds: their number, their modules, and the age of the newest."""


def _interruptions(host: Host) -> list[str]:
    """Recent faults, and the load of this computer if that explains them."""
    told = []
    for feature in host.features.loaded.values():
        if isinstance(feature, CountsFaults):
            count, modules, age_s = feature.recent_faults(_RECENT_S)
            if count:
                plural = "s" if count > 1 else ""
                told.append(
                    f"{count} interruption{plural} of {', '.join(modules)} in the last "
                    f"{_RECENT_S / 60:.0f} minutes, the newest {age_s:.0f} s ago"
                )
    load = overload()
    return [*told, load] if told and load else told


def summary(host: Host, reasons: Sequence[StillReason]) -> str:
    """Which robot, what is started, what moves it, and the first of the reasons that keep it still
    whoever asks.
    """
    loop, motions = host.loop, host.motions
    running = [view.kind for view in loop.modules.views() if view.phase == "running"]
    told = [f"{', '.join(running)} started" if running else "nothing is started"]
    if running or motions:
        told.append(f"moved by {', '.join(motions)}" if motions else "nothing moves it")
        told += _interruptions(host)
    first = [f" {reason.message}" for reason in reasons if reason.is_for_everyone][:1]
    facts = loop.robot_facts
    return f"{facts.kind.capitalize()} robot {facts.name}: {'; '.join(told)}.{''.join(first)}"


def _tightened(loop: ClosedLoop) -> dict[str, object]:
    """Limits that are tighter than the configured ones, by key."""
    base, now = (limits.model_dump(mode="json") for limits in (loop.base.limits, loop.limits))
    return {key: value for key, value in now.items() if value != base[key]}


def status_tool(host: Host) -> Tool[GetStatus]:
    """get_status."""

    async def get_status(arguments: GetStatus, context: CallContext) -> StatusResult:
        return status(host, context, details=arguments.details)

    return Tool(
        name="get_status",
        title="Status of everything",
        description=(
            "How it is, in a sentence; which robot, real or simulated; why it does not move, and "
            "what to do; state and errors of each module."
        ),
        arguments=GetStatus,
        result=StatusResult,
        handler=get_status,
        read_only=True,
        idempotent=True,
    )


def status_resource(host: Host) -> Resource:
    """The result of get_status under `STATUS_URI`."""
    return Resource(
        uri=STATUS_URI,
        name="status",
        title="Status of everything",
        description="The answer of get_status.",
        read=lambda: status(host).model_dump_json(indent=2, exclude_unset=True),
        mime_type="application/json",
    )
