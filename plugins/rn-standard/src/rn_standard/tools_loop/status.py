"""Status of the whole server: get_status, and the same as an MCP resource."""

from __future__ import annotations

import os
import platform
import time
from dataclasses import asdict
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from rn_standard.tools_loop.results import ModuleStatus, RobotStatus, StatusResult
from roboneuron import CallContext, Host, NoArguments, Resource, Tool, __version__
from roboneuron.feature import FAULTS, ClosedLoop

STATUS_URI = "roboneuron://status"


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


def status(host: Host) -> StatusResult:
    """Collect the status."""
    loop = host.loop
    omitted = host.features.omitted
    cause = loop.emergency_stop.cause()
    known: dict[str, Any] = {"emergency_stop_cause": cause, "left_out": omitted}
    robot = RobotStatus(**asdict(loop.robot_facts))
    if unchecked := loop.unchecked_distances:
        robot = robot.model_copy(update={"unchecked": unchecked})
    return StatusResult(
        summary=summary(host),
        robot=robot,
        modules=[ModuleStatus.of(view) for view in loop.modules.views()],
        emergency_stop=loop.emergency_stop.is_latched(),
        **{name: value for name, value in known.items() if value},
        namespace=loop.config.namespace,
        tightened_limits=_tightened(loop),
        uptime_s=round(time.monotonic() - host.started_s, 1),
        pid=os.getpid(),
        versions=_versions(),
        log_directory=str(loop.modules.log_directory),
    )


def summary(host: Host) -> str:
    """One sentence: which robot, what does not work, what moves it, the emergency stop."""
    loop, now_s, motions = host.loop, time.monotonic(), host.motions
    views = loop.modules.views()
    health = {view.kind: view.health(now_s) for view in views}
    faults = [f"{kind} is {word}" for kind, word in health.items() if word in FAULTS]
    running = [view.kind for view in views if view.phase == "running"]
    works = f"{', '.join(running)} {'works' if len(running) == 1 else 'work'}"
    told = ["; ".join(faults) or (works if running else "nothing is started")]
    if running or motions:
        told.append(f"moved by {', '.join(motions)}" if motions else "nothing moves it")
    if loop.emergency_stop.is_latched():
        cause = loop.emergency_stop.cause()
        told.append(f"the emergency stop is latched{f' ({cause})' if cause else ''}")
    facts = loop.robot_facts
    return f"{facts.kind.capitalize()} robot {facts.name}: {'; '.join(told)}."


def _tightened(loop: ClosedLoop) -> dict[str, object]:
    """Limits that are tighter than the configured ones, by key."""
    base, now = (limits.model_dump(mode="json") for limits in (loop.base.limits, loop.limits))
    return {key: value for key, value in now.items() if value != base[key]}


def status_tool(host: Host) -> Tool[NoArguments]:
    """get_status."""

    async def get_status(_: NoArguments, context: CallContext) -> StatusResult:
        return status(host)

    return Tool(
        name="get_status",
        title="Status of everything",
        description=(
            "How it is, in one sentence; which robot this is, real or simulated; state, rates and "
            "errors of each module; whether the emergency stop is latched, and by whom."
        ),
        arguments=NoArguments,
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
