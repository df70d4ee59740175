"""An MCP client drives three mobile bases with one velocity tool, each along its own path; odometry is the judge.

    make demo-bases      or      python examples/drive_bases.py [--output out/demo-bases]

Everything happens over MCP: the paths are sequences of velocities that `publish_velocity_sequence` plays, and
`read_odometry` says where each base came to. A base that is asked for what it cannot do refuses with a reason. Exit
status 0 means that every base ended within the tolerance of its path.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Mapping
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

from rn_robot_bases.odometry import PlanarPose
from rn_robot_bases.paths import PATHS, Segment, planned_track
from rn_robot_bases.picture import draw_track
from rn_robot_bases.platform import PLATFORMS

HERE = Path(__file__).parent
LOOK_PERIOD_S = 0.2
IMPOSSIBLE = {
    "diffdrive": {"linear": {"y": 0.2}},
    "husky": {"linear": {"x": 5.0}},
    "racecar": {"angular": {"z": 0.5}},
}
"""What each cannot do: move sideways, drive at 5 m/s, turn on the spot."""


async def call(client: Client, tool: str, arguments: Mapping[str, Any]) -> tuple[bool, dict[str, Any], str]:
    """Call a tool; whether it succeeded, its structured answer, and its text."""
    result = await client.call_tool(tool, dict(arguments), read_timeout_seconds=180)
    text = " ".join(part.text for part in result.content if isinstance(part, TextContent))
    return not result.is_error, dict(result.structured_content or {}), text


async def must(client: Client, tool: str, arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Call a tool that has to succeed."""
    succeeded, answer, text = await call(client, tool, arguments)
    if not succeeded:
        sys.exit(f"{tool}: {text}")
    return answer


def pose_of(odometry: Mapping[str, Any]) -> PlanarPose:
    """The pose in a nav_msgs/Odometry, heading in -pi .. pi."""
    pose = odometry["pose"]["pose"]
    q = pose["orientation"]
    yaw_rad = math.atan2(2 * (q["w"] * q["z"] + q["x"] * q["y"]), 1 - 2 * (q["y"] ** 2 + q["z"] ** 2))
    return PlanarPose(x_m=pose["position"]["x"], y_m=pose["position"]["y"], yaw_rad=yaw_rad)


async def locate(client: Client, robot: str) -> PlanarPose:
    """Where the base is by its odometry."""
    answer = await must(client, "read_odometry", {"robot": robot})
    return pose_of(answer["messages"][-1])


def to_step(segment: Segment) -> dict[str, Any]:
    """A segment as one step of `publish_velocity_sequence`."""
    message = {"linear": {"x": segment.linear_m_s}, "angular": {"z": segment.angular_rad_s}}
    return {"message": message, "duration_s": segment.duration_s}


async def drive(client: Client, robot: str, console: Console) -> tuple[bool, list[PlanarPose], list[str]]:
    """One base along its path; success, track by odometry, row for the table."""
    path = PATHS[robot]
    await must(client, "start_robot", {"robot": robot})
    succeeded, _, reason = await call(client, "publish_velocity", {"robot": robot, "message": IMPOSSIBLE[robot]})
    if succeeded:
        sys.exit(f"{robot} took a velocity it cannot follow: {IMPOSSIBLE[robot]}")
    console.print(f"  [bold]{robot}[/] refuses {IMPOSSIBLE[robot]}: [dim]{reason.splitlines()[0]}[/]")
    track = [await locate(client, robot)]

    async def watch(done: anyio.Event) -> None:
        while not done.is_set():
            track.append(await locate(client, robot))
            await anyio.sleep(LOOK_PERIOD_S)

    done = anyio.Event()
    with console.status(f"{robot} drives a {path.name}, {path.length_m:.1f} m …"):
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(watch, done)
            steps = [to_step(segment) for segment in path.segments]
            await must(client, "publish_velocity_sequence", {"robot": robot, "steps": steps})
            await anyio.sleep(1.5)  # the base slows down at its own acceleration
            done.set()
    end, goal = await locate(client, robot), planned_track(PLATFORMS[robot], path.segments)[-1]
    await must(client, "stop_robot", {})
    off_m = math.hypot(end.x_m - goal.x_m, end.y_m - goal.y_m)
    off_rad = abs((end.yaw_rad - goal.yaw_rad + math.pi) % (2 * math.pi) - math.pi)
    succeeded = off_m <= path.end_m and off_rad <= path.end_rad
    console.print(f"  {'[green]✓[/]' if succeeded else '[red]✗[/]'} {robot} drove a {path.name}")
    row = [
        robot,
        path.name,
        f"{path.length_m:.1f} m",
        f"{off_m * 100:.0f} cm (≤ {path.end_m * 100:.0f})",
        f"{math.degrees(off_rad):.0f}° (≤ {math.degrees(path.end_rad):.0f})",
        "[green]yes[/]" if succeeded else "[red]no[/]",
    ]
    return succeeded, track, row


async def play(output: Path, console: Console) -> bool:
    """All three bases, one after the other, on one server."""
    output.mkdir(parents=True, exist_ok=True)
    server = StdioServerParameters(
        command=sys.executable,
        args=["-m", "roboneuron.cli.main", "serve", "--config", str(HERE / "three_bases.toml")],
        env=dict(os.environ),
    )
    table = Table(title="Judged by odometry", title_justify="left", title_style="bold")
    for column in ("base", "path", "length", "off at the end", "heading off", "followed"):
        table.add_column(column)
    all_succeeded, pictures = True, []
    console.print("\n[bold]One velocity tool, three bases[/]")
    with (output / "server.log").open("w", encoding="utf-8") as log:
        async with Client(stdio_client(server, errlog=log)) as client:
            for robot in PATHS:
                succeeded, track, row = await drive(client, robot, console)
                all_succeeded &= succeeded
                table.add_row(*row)
                pictures.append(draw_track(PLATFORMS[robot], track, width=480, height=320))
    strip = output / "film-strip.png"
    Image.fromarray(np.concatenate(pictures, axis=1)).save(strip)
    console.print(table)
    console.print(f"  film strip  {strip}", highlight=False)
    return all_succeeded


def main() -> int:
    """Parse the options, drive, say whether it worked."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--output", type=Path, default=Path("out/demo-bases"))
    arguments = parser.parse_args()
    return 0 if anyio.run(play, arguments.output, Console()) else 1


if __name__ == "__main__":
    sys.exit(main())
