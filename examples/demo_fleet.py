"""One agent, one server, three robots: two FR3s pick up different cubes while a mobile base drives
a square.

    make demo-fleet

or `python examples/demo_fleet.py [--seed 7] [--left red] [--right blue]`. Each robot is a cell of
`demo_fleet.toml` with its own processes, gate, limits and emergency stop. The agent is an ordinary
MCP client: `start_all` for each robot, `run_task` for each arm, `publish_velocity_sequence` for the
base, all at the same time. Each robot's own simulator is the judge: the named cube is 10 cm up and
has been held for a second; the base stands at the end of its path and has driven all of it. Exit
status 0 means that every judge says yes and that all three worked at the same time. Film strip, GIF
and the server's log go to `out/demo-fleet/`.
"""

from __future__ import annotations

import argparse
import io
import json
import math
import random
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import anyio
from fleet_film import FleetFilm, draw_from_above
from PIL import Image
from rich.console import Console
from rich.panel import Panel
from rich.table import Table

from rn_robot_bases.paths import PATHS, planned_track
from rn_robot_bases.platform import PLATFORMS
from rn_simulation.planar_motion import PlanarPose
from rn_standard.console.client import leaves_of, spawned_server
from rn_standard.demo.agent import DemoAgent, module_status, simulated_objects
from rn_standard.demo.pace import MachinePace, run_paced
from rn_standard.demo.screen import HOLD_GOAL_S, LIFT_GOAL_M, DemoScreen
from roboneuron import RoboNeuronError

HERE = Path(__file__).parent
BASE, BASE_KIND = "base", "diffdrive"
PATH = PATHS[BASE_KIND]
PLANNED = planned_track(PLATFORMS[BASE_KIND], PATH.segments)
COLOURS = ("red", "green", "blue", "yellow")
LOOK_S = 0.5
"""Period of the agent's status requests, which also provide the film's frames."""
ATTEMPT_S, ATTEMPTS = 50.0, 3
REST_S, HELD_S = 1.5, 5.0
"""Waiting times: the base slows down at its own acceleration, and a cube just lifted must be held
long enough.
"""
LEAST_LENGTH = 0.9
"""Minimum share of the path's length that the base must have driven, because the path ends at its
start.
"""
WHOLE_S = 540.0


@dataclass(kw_only=True)
class Work:
    """Result of one robot's work."""

    robot: str
    task: str
    begun_s: float = math.inf
    ended_s: float = -math.inf
    told: str = ""
    """Answer of the tool."""
    truth: str = ""
    """Statement of the simulator."""
    is_done: bool = False
    status: dict[str, Any] = field(default_factory=dict)
    """Newest answer of get_status."""
    busy: dict[str, Any] = field(default_factory=dict)
    """Newest answer during the work."""


def lifted(colour: str) -> dict[str, Any]:
    """The predicate of run_task: the gripper holds an object, and the cube has been seen lifted for
    a second.
    """
    seen = {
        "kind": "monitor",
        "name": "colour-lifted",
        "options": {"colour": colour, "height_m": 0.12},
    }
    grip = {"kind": "gripper_holds", "least_open": 0.15, "most_open": 0.9}
    return {"kind": "held", "for_s": 1.0, "of": {"kind": "all", "of": [grip, seen]}}


def judge_arm(work: Work, colour: str) -> None:
    """Judge by the arm's simulator: the cube is lifted and has been held; the tool's answer must
    agree.
    """
    thing = next((t for t in simulated_objects(work.status) if t.name == colour), None)
    if thing is None:
        work.truth, work.is_done = "no answer", False
        return
    work.truth = f"{colour} {thing.lifted_m * 100:.1f} cm up, held {thing.held_s:.1f} s"
    work.is_done = thing.held_s >= HOLD_GOAL_S and work.told.startswith("succeeded")


def true_pose(status: Mapping[str, Any]) -> PlanarPose | None:
    """Pose of the base from its simulator; None before it is known."""
    found = json.loads(
        (module_status(status, "robot").get("detail") or {}).get("true_pose", "null")
    )
    return None if found is None else PlanarPose(**found)


def judge_base(work: Work, track: Sequence[PlanarPose]) -> None:
    """Judge by the base's simulator: it stands at the end of its path, and has driven its
    length.
    """
    if not track:
        work.truth, work.is_done = "no answer", False
        return
    end, goal = track[-1], PLANNED[-1]
    off_m = math.hypot(end.x_m - goal.x_m, end.y_m - goal.y_m)
    off_rad = abs((end.yaw_rad - goal.yaw_rad + math.pi) % (2 * math.pi) - math.pi)
    driven_m = sum(math.hypot(b.x_m - a.x_m, b.y_m - a.y_m) for a, b in pairwise(track))
    work.truth = (
        f"{driven_m:.1f} m, {off_m * 100:.0f} cm and {math.degrees(off_rad):.0f}° off its end"
    )
    is_there = off_m <= PATH.end_m and off_rad <= PATH.end_rad
    work.is_done = is_there and driven_m >= LEAST_LENGTH * PATH.length_m and work.told == "done"


def together_s(works: Sequence[Work]) -> float:
    """Time for which all of them worked at once; negative if they never did."""
    return min(work.ended_s for work in works) - max(work.begun_s for work in works)


def write_configuration(output: Path, seed: int) -> Path:
    """Write the configuration, with a scene for each arm."""
    text = (HERE / "demo_fleet.toml").read_text(encoding="utf-8")
    for number, robot in enumerate(("left", "right")):
        text += f"\n[robots.{robot}.plugins.fr3]\nseed = {seed + number}\nstate_rate_hz = 15.0\n"
    path = output / "roboneuron.toml"
    path.write_text(text, encoding="utf-8")
    return path


class Demo:
    """The agent's work with three robots."""

    def __init__(self, agent: DemoAgent, screen: DemoScreen, colours: Mapping[str, str]) -> None:
        self._agent = agent
        self._screen = screen
        self._colours = colours
        self._begun_s = 0.0
        self._said: dict[str, str] = {}
        self.track: list[PlanarPose] = []
        self.film = FleetFilm()
        self.works = {
            name: Work(robot=name, task=f"pick up the {colour} cube")
            for name, colour in colours.items()
        }
        self.works[BASE] = Work(robot=BASE, task=f"drive a {PATH.name} of {PATH.length_m:.0f} m")

    async def start(self) -> None:
        """Start all modules of all robots at once."""
        async with anyio.create_task_group() as tasks:
            for robot in self.works:
                tasks.start_soon(self._agent.call, "start_all", {"robot": robot})

    async def work(self) -> None:
        """Run all three at once, with status requests meanwhile."""
        self._begun_s = time.monotonic()
        await self._look_at_all()
        over = anyio.Event()

        async def watch() -> None:
            while not over.is_set():
                await self._look_at_all()
                await anyio.sleep(LOOK_S)

        async with anyio.create_task_group() as watching:
            watching.start_soon(watch)
            async with anyio.create_task_group() as tasks:
                for robot, colour in self._colours.items():
                    tasks.start_soon(self._pick, robot, colour)
                tasks.start_soon(self._drive)
            over.set()
        await self._look_at_all()
        for robot, colour in self._colours.items():
            judge_arm(self.works[robot], colour)
        judge_base(self.works[BASE], self.track)

    async def stop(self) -> None:
        """Stop all modules of all robots; the server ends next, with everything that still runs."""

        async def stop_one(robot: str) -> None:
            with suppress(RoboNeuronError):
                await self._agent.call("stop_all", {"robot": robot})

        async with anyio.create_task_group() as tasks:
            for robot in self.works:
                tasks.start_soon(stop_one, robot)

    async def _pick(self, robot: str, colour: str) -> None:
        work = self.works[robot]
        work.begun_s = time.monotonic()
        arguments = {"robot": robot, "instruction": work.task, "until": lifted(colour)}
        limits = {"max_s": ATTEMPT_S, "max_attempts": ATTEMPTS, "on_end": "hold"}
        try:
            end = await self._agent.call("run_task", {**arguments, **limits})
            work.told = f"{end['outcome']}, attempt {end['attempts']}"
            self._say(robot, f"{work.told}: {end['reason']}")
        except RoboNeuronError as error:
            work.told = "failed"
            self._say(robot, str(error))
        work.ended_s = time.monotonic()
        with anyio.move_on_after(HELD_S):
            while not any(
                t.name == colour and t.held_s >= HOLD_GOAL_S for t in simulated_objects(work.status)
            ):
                await anyio.sleep(0.1)

    async def _drive(self) -> None:
        work = self.works[BASE]
        work.begun_s = time.monotonic()
        steps = [
            {
                "message": {
                    "linear": {"x": segment.linear_m_s},
                    "angular": {"z": segment.angular_rad_s},
                },
                "duration_s": segment.duration_s,
            }
            for segment in PATH.segments
        ]
        try:
            await self._agent.call("publish_velocity_sequence", {"robot": BASE, "steps": steps})
            work.told = "done"
            self._say(BASE, "at the end of its path")
        except RoboNeuronError as error:
            work.told = "failed"
            self._say(BASE, str(error))
        work.ended_s = time.monotonic()
        await anyio.sleep(REST_S)

    async def _look_at_all(self) -> None:
        images: dict[str, Image.Image] = {}
        captions: dict[str, str] = {}

        async def look(robot: str) -> None:
            work = self.works[robot]
            work.status = await self._agent.call("get_status", {"robot": robot, "details": True})
            if work.begun_s < time.monotonic() and not work.told:
                work.busy = work.status
            if robot == BASE:
                pose = true_pose(work.status)
                if pose is not None:
                    self.track.append(pose)
                images[robot] = draw_from_above(PLANNED, self.track)
                captions[robot] = f"base: {work.task}"
                return
            note = str(module_status(work.status, "inference").get("note") or "")
            if note:
                self._say(robot, note)
            up_m = next(
                (
                    t.lifted_m
                    for t in simulated_objects(work.status)
                    if t.name == self._colours[robot]
                ),
                0.0,
            )
            captions[robot] = f"{robot}: {work.task}" + (
                f", {up_m * 100:.0f} cm up" if up_m > 0.01 else ""
            )
            with suppress(RoboNeuronError):  # a film may lack a frame
                encoded = await self._agent.image("front", robot)
                images[robot] = Image.open(io.BytesIO(encoded)).convert("RGB")

        at_s = time.monotonic() - self._begun_s
        async with anyio.create_task_group() as tasks:
            for robot in self.works:
                tasks.start_soon(look, robot)
        self.film.add(at_s, {name: images.get(name) for name in self.works}, captions)

    def _say(self, robot: str, text: str) -> None:
        if self._said.get(robot) != text:
            self._said[robot] = text
            self._screen.say(f"{time.monotonic() - self._begun_s:5.1f} s  {robot:5}  {text}")


def print_tables(console: Console, works: Sequence[Work]) -> None:
    """Print the modules' state during the work, and the judges' verdicts."""
    rates = Table(
        title="While they worked", title_style="bold", title_justify="left", header_style="dim"
    )
    for column in ("robot", "process", "rate", "median", "p99", "sent", "dropped"):
        rates.add_column(
            column, justify="left" if column in ("robot", "process") else "right", no_wrap=True
        )
    for work in works:
        for module in work.busy.get("modules", ()):
            if module.get("pid") is None:
                continue
            units = (("rate_hz", "Hz"), ("latency_ms", "ms"), ("latency_p99_ms", "ms"))
            numbers = [
                f"{module[key]:.1f} {unit}" if module.get(key) is not None else ""
                for key, unit in units
            ]
            counts = [str(module.get(key, "")) for key in ("published", "dropped")]
            rates.add_row(work.robot, module["module"], *numbers, *counts)
    verdict = Table(title="Judged by each simulator", title_justify="left", title_style="bold")
    for column in ("robot", "task", "tool says", "simulator says", "at work", "done"):
        verdict.add_column(column)
    for work in works:
        took = f"{work.ended_s - work.begun_s:.1f} s" if work.ended_s > work.begun_s else ""
        told = "[green]yes[/]" if work.is_done else "[red]no[/]"
        verdict.add_row(work.robot, work.task, work.told, work.truth, took, told)
    console.print()
    console.print(rates)
    console.print(verdict)
    console.print(
        f"  needed: {LIFT_GOAL_M * 100:.0f} cm up for {HOLD_GOAL_S:.0f} s; at most "
        f"{PATH.end_m * 100:.0f} cm and "
        f"{math.degrees(PATH.end_rad):.0f}° off\n  all three at work at once for "
        f"{together_s(works):.1f} s",
        highlight=False,
    )


async def play(
    seed: int, colours: Mapping[str, str], output: Path, console: Console, pace: MachinePace
) -> bool:
    """Run the demo; return whether every judge says yes."""
    output.mkdir(parents=True, exist_ok=True)
    screen = DemoScreen(console)
    tasks = " · ".join(f"{robot}: pick up the {colour} cube" for robot, colour in colours.items())
    console.print(
        Panel(
            f"{tasks} · base: drive (scenes {seed}, {seed + 1})", title="RoboNeuron", expand=False
        )
    )
    path, log = write_configuration(output, seed), output / "server.log"
    with anyio.fail_after(WHOLE_S):
        async with spawned_server(["--config", str(path)], log) as client:
            demo = Demo(DemoAgent(client, pace), screen, colours)
            with screen.step("connect to the MCP server") as told:
                tools = await DemoAgent(client).tools()
                told.append(f"{len(tools)} typed tools for {len(demo.works)} robots")
            try:
                begun_s = time.monotonic()
                with screen.step("start two arms and a base") as told:
                    await demo.start()
                    told.append(f"nine processes, ready after {time.monotonic() - begun_s:.1f} s")
                await demo.work()
            finally:
                with screen.step("stop everything"):
                    await demo.stop()
    works = list(demo.works.values())
    print_tables(console, works)
    strip, gif = demo.film.save(output)
    console.print(
        f"  film strip  {strip}\n  film        {gif}\n  server log  {log}", highlight=False
    )
    return together_s(works) > 0 and all(work.is_done for work in works)


def main() -> int:
    """Parse the options, run the demo, report success."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument(
        "--seed",
        type=int,
        help="scene of the left arm, the next one for the right; default: new ones",
    )
    parser.add_argument("--left", choices=COLOURS, default="red", help="cube for the left arm")
    parser.add_argument("--right", choices=COLOURS, default="blue", help="cube for the right arm")
    parser.add_argument("--output", type=Path, default=Path("out/demo-fleet"))
    chosen = parser.parse_args()
    seed = random.SystemRandom().randrange(10_000) if chosen.seed is None else chosen.seed
    colours = {"left": chosen.left, "right": chosen.right}
    status = 1
    try:
        console = Console(highlight=False)
        status = run_paced(lambda pace: play(seed, colours, chosen.output, console, pace))
    except* RoboNeuronError as group:
        print(*(f"demo-fleet: {error}" for error in leaves_of(group)), sep="\n", file=sys.stderr)
    except* TimeoutError:
        print(f"demo-fleet: it was not over after {WHOLE_S:g} s.", file=sys.stderr)
    return status


if __name__ == "__main__":
    sys.exit(main())
