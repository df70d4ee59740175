"""What previews of direct moves promise, against what then happens in the simulated cell.

    python benchmarks/bench_preview.py [--scenes 500] [--minutes 60] [--folder out/bench-preview]
    python benchmarks/bench_preview.py --judge

A scene is a random posture of the FR3 among cubes, a lamp and a zone, and one call of move_ee or
move_joints, drawn from the scene's number. The call is made with preview=true, then without, at a
server of `roboneuron serve` in real time. Each scene is a line of the ledger in the folder; a run
goes on where it was, and --judge prints the table of what is there. A joint command that is sent
during a preview would move the joints: how far they moved is noted too.
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
"""After so many scenes the cubes lie elsewhere."""
ATTEMPTS = 8
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
}
"""What limits say of themselves, by the name in the table."""


def kind_of(outcome: str, rule: str, text: str) -> str:
    """One word for how a move ended, of a preview and of a call alike."""
    if outcome == "reached":
        return outcome
    named = next((word for said, word in WORDS.items() if said in text), rule or "short")
    return f"{'refused' if outcome == 'refused' else 'stopped'}: {named}"


class Cell:
    """A server with a simulated FR3, and what its client does."""

    def __init__(self, client: Any) -> None:
        self._client = client

    async def ask(self, tool: str, arguments: dict[str, Any]) -> Any:
        """A call, whatever becomes of it."""
        return await self._client.call_tool(tool, arguments)

    async def must(self, tool: str, **arguments: Any) -> dict[str, Any]:
        """A call that has to succeed."""
        answer = await self.ask(tool, arguments)
        if answer.is_error:
            raise SystemExit(f"{tool} failed: {answer.content[0].text}")
        result: dict[str, Any] = answer.structured_content
        return result

    async def restart(self, seed: int) -> None:
        """The arm at home, among cubes of a seed."""
        await self.must("stop_all")
        await self.must("start_robot", options={"seed": seed})
        await self.must("start_control")

    async def joints(self) -> dict[str, float]:
        """Measured joints."""
        message = (await self.must("read_joint_states"))["messages"][0]
        return dict(zip(message["name"], message["position"], strict=True))

    async def tcp(self) -> list[float]:
        """Measured place of the TCP [m]."""
        place = (await self.must("read_ee_pose"))["messages"][0]["pose"]["position"]
        return [place["x"], place["y"], place["z"]]

    async def cubes(self) -> dict[str, list[float]]:
        """Where the simulator has the cubes."""
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
    """Somewhere around home."""
    return {
        name: min(high - 0.05, max(low + 0.05, home + chance.uniform(-0.45, 0.45)))
        for name, home, low, high in zip(ARM_JOINTS, HOME_RAD, LOWER_RAD, UPPER_RAD, strict=True)
    }


def drawn_call(chance: random.Random, tcp: list[float]) -> tuple[str, dict[str, Any]]:
    """A move to somewhere in and around the workspace."""
    if chance.random() < 0.4:
        return "move_joints", {"positions": drawn_posture(chance)}
    place = chance.uniform(0.26, 0.66), chance.uniform(-0.45, 0.45), chance.uniform(0.0, 0.6)
    delta = [min(0.5, max(-0.5, there - here)) for there, here in zip(place, tcp, strict=True)]
    names = ("dx_m", "dy_m", "dz_m")
    arguments = {name: round(value, 4) for name, value in zip(names, delta, strict=True)}
    return "move_ee", {**arguments, "rz_rad": round(chance.uniform(-0.4, 0.4), 3)}


async def play(cell: Cell, scene: int) -> dict[str, Any]:
    """One scene: to its start, the preview, the call."""
    chance = random.Random(f"preview {scene}")
    for _ in range(ATTEMPTS):
        answer = await cell.ask("move_joints", {"positions": drawn_posture(chance)})
        if not answer.is_error:
            break
    tool, arguments = drawn_call(chance, await cell.tcp())
    before, cubes = await cell.joints(), await cell.cubes()
    promise = await cell.ask(tool, {**arguments, "preview": True})
    after = await cell.joints()
    if promise.is_error:
        raise SystemExit(f"The preview failed: {promise.content[0].text}")
    told = promise.structured_content
    began_s = time.monotonic()
    happened = await cell.ask(tool, arguments)
    took_s = time.monotonic() - began_s
    # the arm comes to its hold after the last action
    await anyio.sleep(0.6)
    text = happened.content[0].text if happened.is_error else ""
    details = (happened.meta or {}).get("roboneuron/error", {})
    rule = details.get("rule", "")
    is_refused = happened.is_error and rule not in ("", "path")
    outcome = "refused" if is_refused else "stopped" if happened.is_error else "reached"
    now = await cell.cubes()
    return {
        "scene": scene,
        "tool": tool,
        "arguments": arguments,
        "promised": kind_of(told["outcome"], told["rule"], told["reason"]),
        "happened": kind_of(outcome, rule, text),
        "text": text[:300],
        "reason": told["reason"][:300],
        "moved_in_preview_rad": max(abs(after[name] - before[name]) for name in ARM_JOINTS),
        "promised_m": told["position_m"],
        "happened_m": await cell.tcp(),
        "promised_cubes": sorted(told["collides_with"]),
        "happened_cubes": sorted(
            f"{name} cube" for name, at in cubes.items() if math.dist(at, now[name]) > MOVED_M
        ),
        "motion_s": told["duration_s"],
        "preview_s": told["took_s"],
        "took_s": took_s,
    }


async def run(folder: Path, scenes: int, minutes: float) -> None:
    """Play what is missing, for so long."""
    ledger = folder / "scenes.jsonl"
    done = {row["scene"] for row in rows_of(folder)}
    missing = [scene for scene in range(scenes) if scene not in done]
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
        cell, cubes = Cell(client), -1
        for scene in missing:
            if time.monotonic() > end_s:
                break
            if scene // CUBES_EVERY != cubes:
                cubes = scene // CUBES_EVERY
                await cell.restart(cubes)
            row = await play(cell, scene)
            with ledger.open("a") as lines:
                lines.write(json.dumps(row) + "\n")
        await cell.must("stop_all")


def rows_of(folder: Path) -> list[dict[str, Any]]:
    """The ledger."""
    path = folder / "scenes.jsonl"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def percentile(values: list[float], share: float) -> float:
    """The smallest value that this share of them does not exceed."""
    return sorted(values)[max(0, math.ceil(share * len(values)) - 1)]


def judge(folder: Path) -> None:
    """Print what is in the ledger."""
    rows, console = rows_of(folder), Console(width=120)
    if not rows:
        raise SystemExit("The ledger is empty.")
    pairs = Counter((row["promised"], row["happened"]) for row in rows)
    columns = sorted({happened for _, happened in pairs})
    table = Table("promised", *columns, title=f"{len(rows)} scenes; columns: what happened")
    for promised in sorted({promised for promised, _ in pairs}):
        table.add_row(promised, *(str(pairs[promised, name] or "") for name in columns))
    console.print(table)
    same = sum(row["promised"] == row["happened"] for row in rows)
    ended = sum((row["promised"] == "reached") == (row["happened"] == "reached") for row in rows)
    cubes = sum(row["promised_cubes"] == row["happened_cubes"] for row in rows)
    pushed = sum(bool(row["happened_cubes"]) for row in rows)
    console.print(f"same outcome and limit: {same}; reached or not: {ended}; of {len(rows)}")
    console.print(f"same cubes moved: {cubes} of {len(rows)} ({pushed} moved some)")
    errors = {
        name: [
            math.dist(row["promised_m"], row["happened_m"]) * 1e3
            for row in rows
            if row["promised"] == row["happened"] and is_reached == (row["promised"] == "reached")
        ]
        for name, is_reached in (("reached", True), ("stopped or refused", False))
    }
    for name, values in errors.items():
        if values:
            median, last = percentile(values, 0.5), percentile(values, 0.99)
            console.print(f"TCP at the end, {name}: median {median:.2f} mm, p99 {last:.2f} mm")
    moving = [row for row in rows if row["motion_s"] > 0.0]
    ratios = [row["took_s"] / row["preview_s"] for row in moving]
    times = [row["preview_s"] for row in rows]
    console.print(
        f"preview: median {percentile(times, 0.5):.2f} s, p99 {percentile(times, 0.99):.2f} s; "
        f"{percentile(ratios, 0.5):.1f} times as fast as the call (median of those that move)"
    )
    moved = max(row["moved_in_preview_rad"] for row in rows)
    console.print(f"joints moved during a preview: at most {moved:.1e} rad")


def main() -> None:
    """Play and judge."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else "")
    parser.add_argument("--scenes", type=int, default=500)
    parser.add_argument("--minutes", type=float, default=60.0, help="longest time of this run")
    parser.add_argument("--folder", type=Path, default=Path("out/bench-preview"))
    parser.add_argument("--judge", action="store_true", help="only print what is there")
    options = parser.parse_args()
    folder = options.folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    if not options.judge:
        anyio.run(run, folder, options.scenes, options.minutes)
    judge(folder)


if __name__ == "__main__":
    main()
