"""The tools by which the agent sees: the status of everything, and a camera's image."""

from __future__ import annotations

import os
import platform
import time
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from pydantic import Field

from roboneuron import __version__
from roboneuron.server.images import Format, check_camera, encode, read_frame
from roboneuron.server.loop import ClosedLoop
from roboneuron.server.results import StatusResult, module_status
from roboneuron.server.tool import Arguments, CallContext, NoArguments, Reply, Result, Tool


class GetCameraImage(Arguments):
    """Arguments of get_camera_image."""

    camera: str = Field(description="Which camera of the robot.")
    format: Format = Field(default="jpeg", description="jpeg is small, png is exact.")
    timeout_s: float = Field(default=5.0, gt=0, le=60, description="How long to wait for the next image, in seconds.")


class CameraImage(Result):
    """What is known of the image that comes beside this."""

    camera: str
    width_px: int
    height_px: int
    stamp_ns: int = Field(description="capture time, ROS clock")
    age_ms: float = Field(description="time from its capture to this answer")
    frame_id: str = Field(description="the camera's optical frame")


@cache
def versions() -> dict[str, str]:
    """Versions of what matters when something is reported."""
    found = {"roboneuron": __version__, "python": platform.python_version()}
    for package in ("mcp", "ros-jazzy-rclpy"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed as a package"
    return found


def status(loop: ClosedLoop, started_s: float) -> StatusResult:
    """The status of everything, `started_s` being the monotonic time of the server's start."""
    return StatusResult(
        modules=[module_status(view) for view in loop.supervisor.views()],
        emergency_stop=loop.emergency_stop.is_latched(),
        emergency_stop_cause=loop.emergency_stop.cause(),
        namespace=loop.config.namespace,
        uptime_s=round(time.monotonic() - started_s, 1),
        pid=os.getpid(),
        versions=versions(),
        log_directory=str(loop.supervisor.log_directory),
    )


def observing_tools(loop: ClosedLoop, started_s: float) -> list[Tool[Any]]:
    """get_status and get_camera_image."""

    async def get_status(_: NoArguments, context: CallContext) -> StatusResult:
        return status(loop, started_s)

    async def get_camera_image(arguments: GetCameraImage, context: CallContext) -> Reply:
        return await context.run(lambda _: _read_image(loop, arguments))

    return [
        Tool(
            name="get_status",
            title="Status of everything",
            description=(
                "State, process, rates, latencies, ages, drops and errors of each module; the emergency stop; versions."
            ),
            arguments=NoArguments,
            result=StatusResult,
            handler=get_status,
            read_only=True,
            idempotent=True,
        ),
        Tool(
            name="get_camera_image",
            title="Look through a camera",
            description="The next image of a camera, as an image. Needs perception to run.",
            arguments=GetCameraImage,
            result=CameraImage,
            handler=get_camera_image,
            read_only=True,
            idempotent=True,
            open_world=True,
            choices={"camera": loop.camera_roles},
        ),
    ]


def _read_image(loop: ClosedLoop, arguments: GetCameraImage) -> Reply:
    spec = loop.robot_spec()
    check_camera(arguments.camera, [camera.name for camera in spec.cameras], spec.name)
    view = loop.supervisor.view("perception")
    hint = "Call start_perception first."
    if view.phase == "running" and view.choice is not None:
        hint = f"Perception runs with the cameras: {view.choice.names.get('cameras', 'none')}."
    frame = read_frame(loop.supervisor.link, loop.config.namespace, arguments.camera, arguments.timeout_s, hint=hint)
    picture = encode(frame, arguments.format)
    height, width = frame.image.shape[:2]
    facts = CameraImage(
        camera=arguments.camera,
        width_px=width,
        height_px=height,
        stamp_ns=frame.stamp_ns,
        age_ms=round((time.time_ns() - frame.stamp_ns) / 1e6, 1),
        frame_id=frame.frame_id,
    )
    return Reply(result=facts, pictures=(picture,))
