"""Predictions of simulated calls, compared with the result in the simulated cell.

    python benchmarks/bench_simulate.py [--scenes 500] [--pushes 50] [--tasks 50] [--places 20]
        [--minutes 60]
    python benchmarks/bench_simulate.py --judge

A scene is a random posture of the FR3 among cubes, a lamp and a zone, and one call of move_ee or
move_joints; a push is a move along the table, past a cube or against it; a task is run_task with a
cube that may be missing; a place is place with a cube in the hand. Everything is drawn from its
number. The call is made with simulate=true, then without, at a server of `roboneuron serve` in
real time. Each is a line of a ledger in the folder; an interrupted run can be resumed, and --judge
prints the tables of existing results. A joint command sent during a simulation would move the
joints, so their motion is noted too.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import random
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import anyio
from direct_cell import bounded
from mcp import StdioServerParameters
from rich.console import Console
from rich.table import Table

from rn_robot_fr3.limits import ARM_JOINTS, LOWER_RAD, UPPER_RAD
from rn_robot_fr3.profile import HOME_RAD
from rn_simulation.ground_truth import SWITCH
from rn_testing.domain import free_ros_domain

CONFIG = """
[robot]
name = "fr3"
[perception]
source = "fr3-sim-camera"
[inference]
backend = "servo"
[control]
controller = "urdf"
[limits]
obstacles = [
    {{ name = "table", lower_m = [-0.3, -0.6, -0.6], upper_m = [1.0, 0.6, 0.0] }},
    {{ name = "lamp", lower_m = [0.25, -0.45, 0.02], upper_m = [0.35, -0.35, 0.8] }},
]
[[limits.zones]]
name = "person"
lower_m = [0.22, 0.22, 0.0]
upper_m = [0.45, 0.45, 0.8]
[supervisor]
state_directory = "{folder}/state"
"""
CUBES_EVERY = 20
"""Number of scenes after which the cubes are placed differently."""
ATTEMPTS = 8
REST_S = 0.6
"""Time in which the arm comes to rest after the last action."""
COLOURS = ("red", "green", "blue", "yellow", "purple")
"""The last colour is in no scene."""
MOVED_M = 0.004
WORDS = {
    "would enter": "zone",
    "outside the workspace": "workspace",
    "apart, at least": "collision",
    "a height of": "height",
    "singular value": "singularity",
    "No posture within": "no_solution",
    "in one step": "joint_jump",
    "beyond its limits": "position",
    "limits shorten": "limits",
    # reported by control meanwhile
    "following actions": "limits",
}
"""Texts of limits, by the name in the table."""


def kind_of(outcome: str, rule: str, text: str) -> str:
    """One word for the end of a motion, for simulated calls and calls alike."""
    if outcome == "reached":
        return outcome
    named = next((word for said, word in WORDS.items() if said in text), rule or "short")
    return f"{'refused' if outcome == 'refused' else 'stopped'}: {named}"


class Cell:
    """A server with a simulated FR3, and its client."""

    def __init__(self, client: Any) -> None:
        self._client = client
        self.seed = -1

    async def ask(self, tool: str, arguments: dict[str, Any]) -> Any:
        """Make a call; errors are returned."""
        return await self._client.call_tool(tool, arguments)

    async def must(self, tool: str, **arguments: Any) -> dict[str, Any]:
        """Make a call that must succeed."""
        answer = await self.ask(tool, arguments)
        if answer.is_error:
            raise SystemExit(f"{tool} failed: {answer.content[0].text}")
        result: dict[str, Any] = answer.structured_content
        return result

    async def restart(self, seed: int) -> None:
        """Restart with the arm at home, among the cubes of a seed."""
        await self.must("stop_all")
        await self.must("start_robot", options={"seed": seed})
        await self.must("start_control")
        self.seed = seed

    async def joints(self) -> dict[str, float]:
        """Measured joints."""
        message = (await self.must("read_joint_states"))["messages"][0]
        return dict(zip(message["name"], message["position"], strict=True))

    async def tcp(self) -> list[float]:
        """Measured position of the TCP [m]."""
        place = (await self.must("read_ee_pose"))["messages"][0]["pose"]["position"]
        return [place["x"], place["y"], place["z"]]

    async def cubes(self) -> dict[str, list[float]]:
        """Positions of the cubes in the simulator."""
        status = await self.must("get_status")
        found = _find(status, "cubes")
        cubes: dict[str, dict[str, Any]] = json.loads(found) if found else {}
        return {name: facts["position_m"] for name, facts in cubes.items()}


def _find(node: Any, key: str) -> Any:
    """The first value of a key at any depth."""
    if isinstance(node, dict):
        if key in node:
            return node[key]
        node = list(node.values())
    if isinstance(node, list):
        return next((found for one in node if (found := _find(one, key))), None)
    return None


def drawn_posture(chance: random.Random) -> dict[str, float]:
    """A random posture around home."""
    return {
        name: min(high - 0.05, max(low + 0.05, home + chance.uniform(-0.45, 0.45)))
        for name, home, low, high in zip(ARM_JOINTS, HOME_RAD, LOWER_RAD, UPPER_RAD, strict=True)
    }


def drawn_call(chance: random.Random, tcp: list[float]) -> tuple[str, dict[str, Any]]:
    """A move to a random target in and around the workspace."""
    if chance.random() < 0.4:
        return "move_joints", {"positions": drawn_posture(chance)}
    place = chance.uniform(0.26, 0.66), chance.uniform(-0.45, 0.45), chance.uniform(0.0, 0.6)
    delta = [min(0.5, max(-0.5, there - here)) for there, here in zip(place, tcp, strict=True)]
    names = ("dx_m", "dy_m", "dz_m")
    arguments = {name: round(value, 4) for name, value in zip(names, delta, strict=True)}
    return "move_ee", {**arguments, "rz_rad": round(chance.uniform(-0.4, 0.4), 3)}


async def compare(cell: Cell, tool: str, arguments: dict[str, Any]) -> dict[str, Any]:
    """The simulation of a call, and then the call."""
    before, cubes = await cell.joints(), await cell.cubes()
    told = await cell.must(tool, **arguments, simulate=True)
    after = await cell.joints()
    began_s = time.monotonic()
    happened = await cell.ask(tool, arguments)
    took_s = time.monotonic() - began_s
    await anyio.sleep(REST_S)
    now = await cell.cubes()
    promised, ended = _words(told, happened)
    return {
        "tool": tool,
        "arguments": arguments,
        "promised": promised,
        "happened": ended,
        "text": happened.content[0].text[:300] if happened.is_error else "",
        "reason": told["reason"][:300],
        "moved_in_simulation_rad": max(abs(after[name] - before[name]) for name in ARM_JOINTS),
        "promised_m": told["position_m"],
        "happened_m": await cell.tcp(),
        "promised_cubes": sorted(told["would_move"]),
        "happened_cubes": sorted(
            f"{name} cube" for name, at in cubes.items() if math.dist(at, now[name]) > MOVED_M
        ),
        "motion_s": told["duration_s"],
        "simulated_s": told["took_s"],
        "took_s": took_s,
    }


def _words(told: dict[str, Any], happened: Any) -> tuple[str, str]:
    """The predicted end of a call, and the actual one."""
    if told["tool"] == "run_task" and not happened.is_error:
        promised = "succeeded" if told["outcome"] == "reached" else told["rule"]
        return promised, happened.structured_content["outcome"]
    details = (happened.meta or {}).get("roboneuron/error", {})
    rule = details.get("rule", "")
    is_refused = happened.is_error and rule not in ("", "path")
    outcome = "refused" if is_refused else "stopped" if happened.is_error else "reached"
    text = happened.content[0].text if happened.is_error else ""
    promised = kind_of(told["outcome"], told["rule"], told["reason"])
    return promised, kind_of(outcome, rule, text)


async def play_scene(cell: Cell, number: int) -> dict[str, Any]:
    """Make a random call from a random posture."""
    if cell.seed != number // CUBES_EVERY:
        await cell.restart(number // CUBES_EVERY)
    chance = random.Random(f"simulation {number}")
    for _ in range(ATTEMPTS):
        answer = await cell.ask("move_joints", {"positions": drawn_posture(chance)})
        if not answer.is_error:
            break
    return await compare(cell, *drawn_call(chance, await cell.tcp()))


async def play_push(cell: Cell, number: int) -> dict[str, Any]:
    """Move a closed hand along the table, past a cube or against it."""
    await cell.restart(2000 + number)
    chance = random.Random(f"push {number}")
    place = chance.choice(list((await cell.cubes()).values()))
    aside_m = chance.uniform(-0.08, 0.08)
    above = [place[0] - 0.09, place[1] + aside_m, 0.2]
    delta = [there - here for there, here in zip(above, await cell.tcp(), strict=True)]
    names = ("dx_m", "dy_m", "dz_m")
    moves = [dict(zip(names, delta, strict=True)), {"gripper_open": 0.0}, {"dz_m": -0.175}]
    for move in moves:
        await cell.ask("move_ee", move)
    await anyio.sleep(REST_S)
    return await compare(cell, "move_ee", {"dx_m": 0.15})


async def play_task(cell: Cell, number: int) -> dict[str, Any]:
    """Run a task to pick up a cube, which may be missing."""
    await cell.restart(1000 + number)
    await cell.must("start_all")
    colour = COLOURS[number % len(COLOURS)]
    lifted = {
        "kind": "monitor",
        "name": "colour-lifted",
        "options": {"colour": colour, "height_m": 0.1},
    }
    holds = {"kind": "gripper_holds", "least_open": 0.15, "most_open": 0.85}
    until = {"kind": "held", "for_s": 1.0, "of": {"kind": "all", "of": [holds, lifted]}}
    instruction = f"pick up the {colour} cube"
    bounds = {"max_s": 20.0, "max_attempts": 1}
    return await compare(cell, "run_task", {"instruction": instruction, "until": until, **bounds})


async def play_place(cell: Cell, number: int) -> dict[str, Any]:
    """Put down a cube that was picked up: beside its place, in the zone, or too far away."""
    await cell.restart(3000 + number)
    await cell.must("start_all")
    chance = random.Random(f"place {number}")
    colour = chance.choice(list(await cell.cubes()))
    holds = {"kind": "gripper_holds", "least_open": 0.15, "most_open": 0.85}
    until = {"kind": "held", "for_s": 1.0, "of": holds}
    await cell.ask("run_task", {"instruction": f"pick up the {colour} cube", "until": until})
    await cell.must("stop_inference")
    await anyio.sleep(REST_S)
    place = {
        "dx_m": round(chance.uniform(-0.2, 0.2), 3),
        "dy_m": round(chance.uniform(-0.3, 0.3), 3),
    }
    return await compare(cell, "place", place)


PLAYS = {"scenes": play_scene, "pushes": play_push, "tasks": play_task, "places": play_place}
"""Functions that create a line of each ledger."""


async def run(folder: Path, wanted: dict[str, int], minutes: float) -> None:
    """Run the missing items, within this time."""
    missing = [
        (what, number)
        for what, count in wanted.items()
        for number in sorted(set(range(count)) - {row["number"] for row in rows_of(folder, what)})
    ]
    if not missing:
        return
    config = folder / "roboneuron.toml"
    config.write_text(CONFIG.format(folder=folder))
    command = ["-m", "roboneuron.cli.main", "serve", "--config", str(config)]
    environment = {**os.environ, SWITCH: "on", "ROS_DOMAIN_ID": str(free_ros_domain())}
    server = StdioServerParameters(
        command=sys.executable, args=[*command, "--log-level", "error"], env=environment
    )
    end_s = time.monotonic() + minutes * 60.0
    async with bounded(server) as client:
        cell = Cell(client)
        for what, number in missing:
            if time.monotonic() > end_s:
                break
            _note(folder, what, {"number": number, **await PLAYS[what](cell, number)})
        await cell.must("stop_all")


def _note(folder: Path, what: str, row: dict[str, Any]) -> None:
    with (folder / f"{what}.jsonl").open("a") as lines:
        lines.write(json.dumps(row) + "\n")


def rows_of(folder: Path, what: str) -> list[dict[str, Any]]:
    """A ledger, by its name in `PLAYS`."""
    path = folder / f"{what}.jsonl"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def percentile(values: list[float], share: float) -> float:
    """The smallest value that is not exceeded by this fraction of them."""
    return sorted(values)[max(0, math.ceil(share * len(values)) - 1)]


def judge(what: str, rows: list[dict[str, Any]]) -> None:
    """Print the results in a ledger."""
    console = Console(width=120)
    pairs = Counter((row["promised"], row["happened"]) for row in rows)
    columns = sorted({happened for _, happened in pairs})
    table = Table("promised", *columns, title=f"{len(rows)} {what}; columns: what happened")
    for promised in sorted({promised for promised, _ in pairs}):
        table.add_row(promised, *(str(pairs[promised, name] or "") for name in columns))
    console.print(table)
    same = sum(row["promised"] == row["happened"] for row in rows)
    good = ("reached", "succeeded")
    ended = sum((row["promised"] in good) == (row["happened"] in good) for row in rows)
    cubes = sum(row["promised_cubes"] == row["happened_cubes"] for row in rows)
    pushed = sum(bool(row["happened_cubes"]) for row in rows)
    console.print(f"same outcome and limit: {same}; reached or not: {ended}; of {len(rows)}")
    console.print(f"same cubes moved: {cubes} of {len(rows)} ({pushed} moved some)")
    errors = {
        name: [
            math.dist(row["promised_m"], row["happened_m"]) * 1e3
            for row in rows
            if row["promised"] == row["happened"] and is_reached == (row["promised"] in good)
        ]
        for name, is_reached in (("reached", True), ("stopped or refused", False))
    }
    for name, values in errors.items():
        if values:
            median, last = percentile(values, 0.5), percentile(values, 0.99)
            console.print(f"TCP at the end, {name}: median {median:.2f} mm, p99 {last:.2f} mm")
    moving = [row for row in rows if row["motion_s"] > 0.0]
    ratios = [row["took_s"] / row["simulated_s"] for row in moving]
    times = [row["simulated_s"] for row in rows]
    console.print(
        f"simulation: median {percentile(times, 0.5):.2f} s, p99 {percentile(times, 0.99):.2f} s; "
        f"{percentile(ratios, 0.5):.1f} times as fast as the call (median of those that move)"
    )
    moved = max(row["moved_in_simulation_rad"] for row in rows)
    console.print(f"joints moved during a simulation: at most {moved:.1e} rad")


def main() -> None:
    """Run and report."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else "")
    parser.add_argument("--scenes", type=int, default=500)
    parser.add_argument("--pushes", type=int, default=50, help="along the table, past cubes")
    parser.add_argument("--tasks", type=int, default=50)
    parser.add_argument("--places", type=int, default=20, help="of a cube in the hand")
    parser.add_argument("--minutes", type=float, default=60.0, help="longest time of this run")
    parser.add_argument("--folder", type=Path, default=Path("out/bench-simulate"))
    parser.add_argument("--judge", action="store_true", help="only print what is there")
    options = parser.parse_args()
    folder = options.folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    if not options.judge:
        wanted = {what: getattr(options, what) for what in PLAYS}
        anyio.run(run, folder, wanted, options.minutes)
    for what in PLAYS:
        if rows := rows_of(folder, what):
            judge(what, rows)


if __name__ == "__main__":
    main()
