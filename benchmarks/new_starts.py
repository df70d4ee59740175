"""Random sequences of starts, switches, stops, releases, recoveries and crashes: nothing moves
without a new start.

    python benchmarks/new_starts.py --engine mujoco --sequences 50 --folder /tmp/new-starts

Each sequence requests motion (set_instruction, run_task, start_inference, move_joints, a published
trajectory, a lead), may switch a module meanwhile, stops the arm (emergency stop by tool, topic,
file or signal; a fault of the robot; maintenance; a module killed, frozen or stopped; the call
cancelled; the lead handed back), and then performs everything that ends a stop: reset, recovery,
back in service, starts and restarts of modules, switches. From standstill until the next request
for motion, no joint of the simulation may move by more than 0.02 rad. Then motion is requested, and
the arm must move.
Failures caused by a busy machine (a restart by a time-out, a late image) are counted separately;
they break no rule.

Results are lines in FOLDER/ENGINE.jsonl; an interrupted run can be resumed.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path

from new_start_cell import (
    BRAKE_S,
    FRANKA_SIM,
    MOVED_RAD,
    STOPS,
    SWITCHES,
    WATCH_S,
    Cell,
    go_on,
    served_cell,
    start,
    stop,
)

STOPS_A_SEQUENCE = 2
MOVES_S = 20.0
COLOURS = ("red", "green", "blue")


@dataclass(kw_only=True)
class Result:
    """One sequence.

    Attributes:
        moved_rad: largest motion without a start.
        problems: violations of the rule; empty for none.
        hindered: why it was not completed.
        idle: starts after which the arm did not move in time; they do not affect the rule.
    """

    number: int
    engine: str
    restart: str
    steps: list[str] = field(default_factory=list)
    moved_rad: float = 0.0
    problems: list[str] = field(default_factory=list)
    hindered: str = ""
    idle: int = 0
    starts: int = 0
    took_s: float = 0.0


def sequence(cell: Cell, number: int, engine: str, restart: str) -> Result:
    """Run the sequence with this number, which determines everything."""
    draw = random.Random(f"{engine} {number}")
    result = Result(number=number, engine=engine, restart=restart)
    began_s = time.monotonic()
    try:
        cell.everything_runs()
        for _ in range(STOPS_A_SEQUENCE):
            _cycle(cell, draw, result, engine)
    except RuntimeError as error:
        result.hindered = str(error)
    result.took_s = round(time.monotonic() - began_s, 1)
    return result


def _cycle(cell: Cell, draw: random.Random, result: Result, engine: str) -> None:
    how = draw.choice([start for start in STOPS if start != "lead" or engine != FRANKA_SIM])
    stops = STOPS[how]
    result.steps.append(how)
    result.starts += 1
    start(cell, how, f"pick up the {draw.choice(COLOURS)} cube")
    try:
        cell.until(cell.witness.is_moving, MOVES_S, "the arm moves")
    except RuntimeError:
        result.idle += 1
    time.sleep(draw.uniform(0.0, 1.5))
    switch = draw.choice((*SWITCHES, "", ""))
    if switch:
        mode = "cold" if switch.endswith("_cold") else "warm"
        result.steps.append(f"{switch} meanwhile")
        cell.later(switch.removesuffix("_cold"), mode=mode)
        time.sleep(draw.uniform(0.0, 4.0))
    how = draw.choice(stops)
    result.steps.append(how)
    stop(cell, how)
    time.sleep(0.5)  # an ended robot module reports no motion
    if how == "freeze_robot":
        result.steps += cell.resume()
    if cell.modules()["robot"]["phase"] == "running":
        cell.until(cell.witness.is_still, BRAKE_S + 5.0, f"the arm stands after {how}")
    since_s = time.monotonic()
    result.steps += go_on(cell, draw)
    cell.join(timeout_s=120.0)
    time.sleep(WATCH_S)  # time in which nothing should happen
    moved_rad = cell.witness.moved_rad(since_s)
    result.moved_rad = max(result.moved_rad, round(moved_rad, 4))
    if moved_rad > MOVED_RAD:
        result.problems.append(f"moved by {moved_rad:.3f} rad after {how} and {result.steps[-3:]}")


def main() -> int:
    """Run, or resume."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--engine", choices=("pybullet", "mujoco", FRANKA_SIM), default="mujoco")
    parser.add_argument("--sequences", type=int, default=50)
    parser.add_argument("--first", type=int, default=0, help="number of the first one")
    parser.add_argument("--minutes", type=float, default=600.0, help="no sequence begins later")
    parser.add_argument("--folder", type=Path, required=True)
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    ledger = arguments.folder / f"{arguments.engine}.jsonl"
    known = (
        [json.loads(line) for line in ledger.read_text().splitlines()] if ledger.exists() else []
    )
    numbers = range(arguments.first, arguments.first + arguments.sequences)
    missing = [number for number in numbers if number not in {line["number"] for line in known}]
    end_s = time.monotonic() + arguments.minutes * 60
    # Half of them with automatic restarts of all modules, each half on its own server.
    for restart in ("on_failure", "never"):
        mine = [number for number in missing if (number % 2 == 0) == (restart == "on_failure")]
        if not mine or time.monotonic() > end_s:
            continue
        with served_cell(
            arguments.folder / f"{arguments.engine}-{restart}", arguments.engine, restart, 3
        ) as cell:
            for number in mine:
                if time.monotonic() > end_s:
                    break
                result = sequence(cell, number, arguments.engine, restart)
                known.append(asdict(result))
                with ledger.open("a") as file:
                    file.write(json.dumps(known[-1]) + "\n")
                print(json.dumps(known[-1]), flush=True)
    done = [line for line in known if line["number"] in numbers]
    bad = [line for line in done if line["problems"]]
    starts, idle = sum(line["starts"] for line in done), sum(line["idle"] for line in done)
    hindered = sum(bool(line["hindered"]) for line in done)
    farthest = max((line["moved_rad"] for line in done), default=0.0)
    print(
        f"{arguments.engine}: {len(done)} sequences, {starts} starts ({idle} without motion in "
        "time), farthest motion "
        f"without a start {farthest:.4f} rad, {len(bad)} broke the rule, {hindered} hindered"
    )
    return int(
        bool(bad) or len(done) < len(numbers) or idle * 3 > starts or hindered * 3 > len(done)
    )


if __name__ == "__main__":
    sys.exit(main())
