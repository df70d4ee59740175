"""An MCP client drives three mobile bases at the same time, each along its own path, judged by
odometry.

    make demo-bases      or      python examples/drive_bases.py [--output out/demo-bases]

Everything happens over MCP, with one server for all: the paths are velocity sequences for
`publish_velocity_sequence`, and `read_odometry` returns where each base ended. A base refuses an
impossible velocity with a reason. Exit status 0 means that every base ended within the tolerance of
its path, and that all three drove at the same time.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import anyio
import numpy as np
from mcp import Client, StdioServerParameters
from mcp.client.stdio import stdio_client
from mcp.types import TextContent
from PIL import Image
from rich.console import Console
from rich.table import Table

from rn_robot_bases.paths import PATHS, Segment, planned_track
from rn_robot_bases.picture import draw_track
from rn_robot_bases.platform import PLATFORMS
from rn_simulation.planar_motion import PlanarPose
from rn_standard.console.client import leaves_of
from rn_standard.demo.pace import MachinePace, run_paced
from roboneuron import NotReadyError, RoboNeuronError

HERE = Path(__file__).parent
LOOK_PERIOD_S = 0.2
IMPOSSIBLE = {
    "diffdrive": {"linear": {"y": 0.2}},
    "husky": {"linear": {"x": 5.0}},
    "racecar": {"angular": {"z": 0.5}},
}
"""Impossible commands: move sideways, drive at 5 m/s, turn on the spot."""


async def call(
    client: Client, tool: str, arguments: Mapping[str, Any]
) -> tuple[bool, dict[str, Any], str]:
    """Call a tool; return whether it succeeded, its structured answer, and its text."""
    result = await client.call_tool(tool, dict(arguments), read_timeout_seconds=180)
    text = " ".join(part.text for part in result.content if isinstance(part, TextContent))
    return not result.is_error, dict(result.structured_content or {}), text


async def must(client: Client, tool: str, arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Call a tool that must succeed. Raises NotReadyError with its text."""
    succeeded, answer, text = await call(client, tool, arguments)
    if not succeeded:
        raise NotReadyError(f"{tool}: {text}")
    return answer


def pose_of(odometry: Mapping[str, Any]) -> PlanarPose:
    """The pose in a nav_msgs/Odometry, heading in -pi .. pi."""
    pose = odometry["pose"]["pose"]
    q = pose["orientation"]
    yaw_rad = math.atan2(
        2 * (q["w"] * q["z"] + q["x"] * q["y"]), 1 - 2 * (q["y"] ** 2 + q["z"] ** 2)
    )
    return PlanarPose(x_m=pose["position"]["x"], y_m=pose["position"]["y"], yaw_rad=yaw_rad)


async def locate(client: Client, robot: str) -> PlanarPose:
    """Pose of the base from its odometry."""
    answer = await must(client, "read_odometry", {"robot": robot})
    return pose_of(answer["messages"][-1])


def to_step(segment: Segment) -> dict[str, Any]:
    """Convert a segment to a step of `publish_velocity_sequence`."""
    message = {"linear": {"x": segment.linear_m_s}, "angular": {"z": segment.angular_rad_s}}
    return {"message": message, "duration_s": segment.duration_s}


@dataclass
class Drive:
    """Result of one base: its track by odometry, its row of the table, and when it drove (monotonic
    time).
    """

    succeeded: bool = False
    track: list[PlanarPose] = field(default_factory=list)
    row: list[str] = field(default_factory=list)
    begun_s: float = 0.0
    ended_s: float = 0.0


async def check_refusal(client: Client, robot: str, console: Console) -> None:
    """Check that a base refuses an impossible command with a reason."""
    succeeded, _, reason = await call(
        client, "publish_velocity", {"robot": robot, "message": IMPOSSIBLE[robot]}
    )
    if succeeded:
        raise NotReadyError(f"{robot} took a velocity it cannot follow: {IMPOSSIBLE[robot]}")
    console.print(
        f"  [bold]{robot}[/] refuses {IMPOSSIBLE[robot]}: [dim]{reason.splitlines()[0]}[/]"
    )


async def drive(client: Client, robot: str, made: Drive, pace: MachinePace) -> None:
    """Drive one base along its path."""
    path = PATHS[robot]
    track = made.track
    track.append(await locate(client, robot))

    async def watch(done: anyio.Event) -> None:
        while not done.is_set():
            track.append(await locate(client, robot))
            await anyio.sleep(LOOK_PERIOD_S)

    done = anyio.Event()
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(watch, done)
        steps = [to_step(segment) for segment in path.segments]
        made.begun_s = time.monotonic()
        await must(client, "publish_velocity_sequence", {"robot": robot, "steps": steps})
        made.ended_s = time.monotonic()
        await anyio.sleep(1.5)  # the base slows down at its own acceleration
        done.set()
    pace.note(await must(client, "get_status", {"robot": robot}))
    end, goal = await locate(client, robot), planned_track(PLATFORMS[robot], path.segments)[-1]
    await must(client, "stop_robot", {"robot": robot})
    off_m = math.hypot(end.x_m - goal.x_m, end.y_m - goal.y_m)
    off_rad = abs((end.yaw_rad - goal.yaw_rad + math.pi) % (2 * math.pi) - math.pi)
    made.succeeded = off_m <= path.end_m and off_rad <= path.end_rad
    made.row = [
        robot,
        path.name,
        f"{path.length_m:.1f} m",
        f"{off_m * 100:.0f} cm (≤ {path.end_m * 100:.0f})",
        f"{math.degrees(off_rad):.0f}° (≤ {math.degrees(path.end_rad):.0f})",
        "[green]yes[/]" if made.succeeded else "[red]no[/]",
    ]


async def play(output: Path, console: Console, pace: MachinePace) -> bool:
    """Drive all three bases at once, with one server."""
    output.mkdir(parents=True, exist_ok=True)
    server = StdioServerParameters(
        command=sys.executable,
        args=["-m", "roboneuron.cli.main", "serve", "--config", str(HERE / "three_bases.toml")],
        env=dict(os.environ),
    )
    table = Table(title="Judged by odometry", title_justify="left", title_style="bold")
    for column in ("base", "path", "length", "off at the end", "heading off", "followed"):
        table.add_column(column)
    drives = {robot: Drive() for robot in PATHS}
    console.print("\n[bold]One server, three bases at once[/]")
    with (output / "server.log").open("w", encoding="utf-8") as log:
        async with Client(stdio_client(server, errlog=log)) as client:
            async with anyio.create_task_group() as tasks:
                for robot in PATHS:
                    tasks.start_soon(must, client, "start_robot", {"robot": robot})
            for robot in PATHS:
                await check_refusal(client, robot, console)
            with console.status("all three drive …"):
                async with anyio.create_task_group() as tasks:
                    for robot, made in drives.items():
                        tasks.start_soon(drive, client, robot, made, pace)
    pictures = [
        draw_track(PLATFORMS[robot], made.track, width=480, height=320)
        for robot, made in drives.items()
    ]
    for made in drives.values():
        table.add_row(*made.row)
    together_s = min(made.ended_s for made in drives.values()) - max(
        made.begun_s for made in drives.values()
    )
    strip = output / "film-strip.png"
    Image.fromarray(np.concatenate(pictures, axis=1)).save(strip)
    console.print(table)
    console.print(f"  all three on their way at once for {together_s:.1f} s", highlight=False)
    console.print(f"  film strip  {strip}", highlight=False)
    return together_s > 0 and all(made.succeeded for made in drives.values())


def main() -> int:
    """Parse the options, drive, report success."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--output", type=Path, default=Path("out/demo-bases"))
    arguments = parser.parse_args()
    status = 1
    try:
        status = run_paced(lambda pace: play(arguments.output, Console(), pace))
    except* RoboNeuronError as group:
        print(*leaves_of(group), sep="\n", file=sys.stderr)
    return status


if __name__ == "__main__":
    sys.exit(main())
