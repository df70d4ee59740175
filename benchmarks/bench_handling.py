"""Benchmark: pick, place and push of an agent in served cells, judged by the simulator's truth.

    python benchmarks/bench_handling.py --scenes 200 --engine pybullet --stepped --ledger FILE

A ledger gets one line for each scene; scenes that it has are not played again. With --stepped,
time passes only while commands are carried out, so that a busy machine changes no motion.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections import Counter
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Self

import anyio
import numpy as np

from rn_eval.statistics import proportion
from rn_robot_fr3.scene import random_cubes
from rn_simulation.cubes import RGBA_BY_COLOUR
from rn_simulation.engine import ENGINES
from rn_testing.agent import Agent, client_of
from rn_testing.domain import free_ros_domain
from roboneuron import ConfigurationError

CONFIG = """
[robot]
name = "fr3"
{robot}[perception]
source = "fr3-sim-camera"
[control]
controller = "urdf"
{control}[plugins.fr3-sim-camera]
width = 640
height = 480
[plugins.fr3]
engine = "{engine}"
seed = {seed}
colours = {colours}
{driver}[supervisor]
start_timeout_s = 180.0
state_directory = "{state}"
"""
STEPPED = {
    "robot": "command_timeout_s = 90.0\nserver_timeout_s = 30.0\n",
    "control": "action_timeout_s = 60.0\nstate_timeout_s = 30.0\nserver_timeout_s = 30.0\n",
    "driver": "stepped = true\n",
}
"""The simulation waits for late commands, so waiting for them must not end a motion."""
LIFTED_M, NEIGHBOUR_M = 0.05, 0.003
ON_M, PLACED_M = 0.015, 0.02
"""Largest errors of a success: of a stacked cube's middle, and of one on the table."""
GAP_M = 0.03
SETTLED_M, SETTLE_S = 5e-4, 5.0
_DRAWS, _SCENE_S = 1000, 600.0
Truth = dict[str, np.ndarray]


@dataclass
class Tally:
    """Results of one kind of call."""

    calls: int = 0
    done: int = 0
    errors_m: list[float] = field(default_factory=list)
    took_s: list[float] = field(default_factory=list)
    neighbours: int = 0
    untold: int = 0
    refused: list[str] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)

    def __iadd__(self, other: Tally) -> Self:
        """Add the results of another scene."""
        for part in fields(self):
            total = getattr(self, part.name) + getattr(other, part.name)
            setattr(self, part.name, total)
        return self

    def row(self) -> dict[str, Any]:
        """The figures."""
        errors = np.array(self.errors_m or [np.nan]) * 1e3
        share = proportion(self.done, self.calls)
        return {
            "calls": self.calls,
            "done": self.done,
            "share_95": [round(share.low, 3), round(share.high, 3)],
            "refused": dict(Counter(self.refused)),
            "failed": self.failed,
            "error_median_mm": round(float(np.median(errors)), 1),
            "error_95_mm": round(float(np.percentile(errors, 95)), 1),
            "neighbours_moved": self.neighbours,
            "neighbours_moved_untold": self.untold,
            "took_median_s": round(float(np.median(self.took_s or [np.nan])), 1),
        }


class Judge:
    """Calls tools, and compares what they did with the truth."""

    def __init__(self, agent: Agent, tallies: dict[str, Tally]) -> None:
        self._agent, self._tallies = agent, tallies

    async def truth(self) -> Truth:
        """Position of each cube at rest."""
        deadline_s = time.monotonic() + SETTLE_S
        before, found = None, await self._read()
        while time.monotonic() < deadline_s:
            if before is not None and all(
                np.linalg.norm(found[name] - before[name]) < SETTLED_M for name in found
            ):
                break
            await anyio.sleep(0.3)
            before, found = found, await self._read()
        return found

    async def _read(self) -> Truth:
        modules = (await self._agent.do("get_status"))["modules"]
        robot = next(one for one in modules if one["module"] == "robot")
        cubes = json.loads(robot["detail"]["cubes"])
        return {name: np.array(cube["position_m"]) for name, cube in cubes.items()}

    async def judged(
        self, tool: str, kind: str, colour: str, before: Truth, **arguments: object
    ) -> tuple[dict[str, Any], Truth] | None:
        """The answer and the truth after a call; None if it did not succeed."""
        tally = self._tallies.setdefault(kind, Tally())
        tally.calls += 1
        began_s = time.monotonic()
        succeeded, answer, text = await self._agent.call(tool, **arguments)
        after = await self.truth()
        moved = {
            name
            for name in before
            if name != colour and np.linalg.norm(after[name] - before[name]) > NEIGHBOUR_M
        }
        told = {one["object"].split()[0] for one in answer.get("others_moved") or ()}
        for unsure in ("not_seen_well", "not_seen_after"):
            told |= {one.split()[0] for one in answer.get(unsure, ())}
        tally.neighbours += len(moved)
        tally.untold += len(moved - told)
        if not succeeded:
            if moved or np.linalg.norm(after[colour] - before[colour]) > NEIGHBOUR_M:
                tally.failed.append(f"{arguments}: {text[:160]}")
            else:
                tally.refused.append(text[:120])
            return None
        tally.took_s.append(time.monotonic() - began_s)
        return answer, after

    def note(self, kind: str, error_m: float, most_m: float, what: str) -> bool:
        """Add an error; whether the call was a success."""
        tally = self._tallies[kind]
        tally.errors_m.append(error_m)
        is_done = error_m <= most_m
        tally.done += is_done
        if not is_done:
            tally.failed.append(f"{what}: {error_m * 1000:.1f} mm")
        return is_done

    async def pick(self, kind: str, colour: str) -> bool:
        """Pick a cube up; whether it is lifted."""
        before = await self.truth()
        outcome = await self.judged("pick", kind, colour, before, object=colour)
        if outcome is None:
            return False
        answer, after = outcome
        lifted = after[colour][2] - before[colour][2] > LIFTED_M
        error_m = float(np.linalg.norm(np.array(answer["grasped_at_m"]) - before[colour]))
        if not lifted or not answer["holds"]:
            self._tallies[kind].failed.append(f"{colour} lifted {lifted}, told {answer['holds']}")
            return False
        return self.note(kind, error_m, PLACED_M, f"grasp of {colour}")


async def play(
    agent: Agent, judge: Judge, edges: dict[str, float], random: np.random.Generator
) -> None:
    """One scene: beside, from beside onto, from the stack to a free position, then a push.

    Args:
        agent, judge: of the scene.
        edges: of each cube [m].
        random: for what is done.
    """
    for kind in ("robot", "perception", "control"):
        await agent.do(f"start_{kind}")
    await agent.do("look")
    names = random.permutation(sorted(await judge.truth())).tolist()
    one, other, third = names[:3]
    if await judge.pick("pick", one):
        side = random.choice(["+x", "-x", "+y", "-y"])
        before = await judge.truth()
        outcome = await judge.judged(
            "place", "place beside", one, before, beside=other, side=side, gap_m=GAP_M
        )
        if outcome is None:
            await agent.call("move_ee", gripper_open=1.0)
        else:
            after = outcome[1]
            apart_m = float(np.linalg.norm(after[one][:2] - after[other][:2]))
            gap_m = apart_m - (edges[one] + edges[other]) / 2
            judge.note("place beside", abs(gap_m - GAP_M), PLACED_M, f"{one} beside {other}")
    if await judge.pick("pick beside a neighbour", one):
        before = await judge.truth()
        outcome = await judge.judged("place", "place on", one, before, on=third)
        if outcome is None:
            await agent.call("move_ee", gripper_open=1.0)
        else:
            after = outcome[1]
            off_m = float(np.linalg.norm(after[one][:2] - after[third][:2]))
            is_on = after[one][2] - after[third][2] > 0.03
            judge.note("place on", off_m if is_on else 1.0, ON_M, f"{one} on {third}")
    if await judge.pick("pick from a stack", one):
        before = await judge.truth()
        target = free_place(before, one, random)
        outcome = await judge.judged(
            "place", "place at", one, before, position_m=[float(value) for value in target]
        )
        if outcome is not None:
            off_m = float(np.linalg.norm(outcome[1][one][:2] - target))
            judge.note("place at", off_m, PLACED_M, f"{one} at {target}")
    await agent.do("move_to", name="home")
    before = await judge.truth()
    dx_m, dy_m = [(0.05, 0.0), (-0.05, 0.0), (0.0, 0.05), (0.0, -0.05)][random.integers(4)]
    outcome = await judge.judged("push", "push", other, before, object=other, dx_m=dx_m, dy_m=dy_m)
    if outcome is not None:
        off_m = float(np.linalg.norm((outcome[1][other] - before[other])[:2] - [dx_m, dy_m]))
        judge.note("push", off_m, 0.01, f"push of {other}")


def free_place(truth: Truth, colour: str, random: np.random.Generator) -> np.ndarray:
    """A place (2,) that is 10 cm away from all other cubes."""
    others = [place[:2] for name, place in truth.items() if name != colour]
    for _ in range(_DRAWS):
        place = random.uniform([0.40, -0.22], [0.60, 0.22])
        if all(np.linalg.norm(place - other) > 0.10 for other in others):
            return np.round(place, 3)
    raise RuntimeError("There is no free place.")


def main() -> None:
    """Play the scenes that the ledger lacks, and print one line for each kind of call."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", type=int, default=10)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--engine", default="pybullet", choices=ENGINES)
    parser.add_argument("--stepped", action="store_true", help="time waits for commands")
    parser.add_argument("--ledger", type=Path, help="JSON lines; default: none is kept")
    arguments = parser.parse_args()
    ledger: Path | None = arguments.ledger
    mode = {"engine": arguments.engine, "stepped": arguments.stepped}
    rows: dict[int, dict[str, Any]] = {}
    if ledger is not None and ledger.exists():
        read = [json.loads(line) for line in ledger.read_text().splitlines()]
        rows = {row["seed"]: row for row in read if row.items() >= mode.items()}
    seeds = range(arguments.first, arguments.first + arguments.scenes)
    try:
        for seed in seeds:
            if seed in rows:
                continue
            tallies = scene(seed, arguments.engine, arguments.stepped)
            kinds = {kind: asdict(tally) for kind, tally in tallies.items()}
            rows[seed] = {"seed": seed, **mode, "kinds": kinds}
            print(f"scene {seed}:", json.dumps({k: [t.calls, t.done] for k, t in tallies.items()}))
            if ledger is not None:
                with ledger.open("a") as file:
                    file.write(json.dumps(rows[seed]) + "\n")
    except KeyboardInterrupt:
        print("ended early; so far:")
    totals: dict[str, Tally] = {}
    played = [rows[seed]["kinds"] for seed in seeds if rows.get(seed, {}).get("kinds")]
    for kinds in played:
        for kind, parts in kinds.items():
            totals.setdefault(kind, Tally())
            totals[kind] += Tally(**parts)
    print(f"{len(played)} scenes, {arguments.engine}")
    for kind, tally in totals.items():
        print(kind, json.dumps(tally.row()), flush=True)


def scene(seed: int, engine: str, stepped: bool) -> dict[str, Tally]:
    """Serve and play one scene; nothing if these cubes do not fit on the table."""
    random = np.random.default_rng([seed, 50])
    colours = random.permutation(sorted(RGBA_BY_COLOUR))[: random.integers(3, 6)].tolist()
    try:
        cubes = random_cubes(seed, colours)
    except ConfigurationError:
        return {}
    tallies: dict[str, Tally] = {}
    waits = STEPPED if stepped else dict.fromkeys(STEPPED, "")
    edges = {cube.name: cube.edge_m for cube in cubes}
    with tempfile.TemporaryDirectory() as folder:
        config = Path(folder) / "roboneuron.toml"
        config.write_text(
            CONFIG.format(
                engine=engine,
                seed=seed,
                colours=json.dumps(colours),
                state=f"{folder}/state",
                **waits,
            )
        )
        environment = {
            **os.environ,
            "ROS_DOMAIN_ID": str(free_ros_domain()),
            "XDG_STATE_HOME": folder,
            "ROBONEURON_SIMULATOR_TRUTH": "on",
        }

        async def scenario() -> None:
            async with client_of(config, environment, "--log-level", "error") as client:
                agent = Agent(client)
                with anyio.fail_after(_SCENE_S):
                    await play(agent, Judge(agent, tallies), edges, random)

        anyio.run(scenario)
    return tallies


if __name__ == "__main__":
    main()
