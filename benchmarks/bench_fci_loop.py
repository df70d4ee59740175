"""A served FR3 behind franka-sim with both enforcement flags: latency, a policy with warm switches,
random actions.

    python benchmarks/bench_fci_loop.py --minutes 30 [--busy 0,8] [--parts latency,policy,random]
    [--actions 10000]

- `latency`: from a command to the first motion.
- `policy`: 20 Hz with warm switches at random times, always moving; faults, violations, and the
  period of the control loop from the arrival times of commands at the simulator.
- `random`: actions of any size and direction on the action topic.

`--busy 0,8` runs everything twice, with no and with eight busy processes. All results come from the
simulator's record (`fci_judge`).

Events are written at once to out/bench-fci/loop/PART-busyN/events.jsonl, and the simulator's record
to go-M/, 0.2 GB in ten minutes. An interrupted run is resumed in another go; `--judge` only prints
existing results, `--fresh` starts again.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from bench_fci import latency, open_driver
from fci_cell import PYTHON, STRICT, FciCell
from fci_judge import Limits, Loop, print_loops, read_go

sys.path.pop(0)

from fci_ledger import Ledger, look

from rn_robot_fr3.fci.simulator import FrankaSim
from roboneuron.ros.qos import NEWEST

OUT = Path("out/bench-fci/loop")
PARTS = ("latency", "policy", "random")
SWITCH_S = (8.0, 25.0)
ACTION_HZ = 50.0
LATENCY_TRIALS = 30
AFTER_SWITCH_S = 2.0
"""Time in which the old backend's process ends."""
LEAST_MOVING = 0.1
"""Fraction of the time; a standing arm keeps every limit. Control holds it while images are late,
as on a busy machine.
"""
BUSY = "import os\np = os.getppid()\nwhile os.getppid() == p:\n    for _ in range(100000): pass"


def policy(cell: FciCell, ledger: Ledger, minutes: float, seed: int) -> None:
    """Run the policy with warm switches, until the arm has moved for `minutes` in all goes
    together.
    """
    dice = random.Random(seed + len(ledger.all("go")))
    cell.start_policy()
    left_s = 60.0 * minutes - ledger.done_s()
    ledger.note("began")
    end_s = time.monotonic() + left_s
    next_s, backend, fault = time.monotonic() + dice.uniform(*SWITCH_S), "sway", ""
    told_s = time.monotonic()
    while time.monotonic() < end_s:
        time.sleep(0.25)
        fault = look(cell, ledger, fault)
        if time.monotonic() > told_s + 60.0:
            told_s += 60.0
            print(
                f"    {ledger.done_s() / 60.0:.1f} min, {len(ledger.all('fault'))} faults",
                flush=True,
            )
        if time.monotonic() < next_s:
            continue
        other = "swing" if backend == "sway" else "sway"
        began_s = time.monotonic()
        try:
            result = cell.agent.do("switch_inference", backend=other)
            ledger.note(
                "switch", done=True, began_s=began_s, gap_ms=float(result.get("gap_s") or 0.0) * 1e3
            )
            backend = other
        except RuntimeError as error:
            ledger.note("switch", done=False, began_s=began_s, why=str(error))
            print(f"    switch: {error}", flush=True)
        next_s = time.monotonic() + dice.uniform(*SWITCH_S)
    cell.record(1.0)  # so that buffered data is written
    ledger.note("ended", dropped=cell.agent.modules()["control"].get("dropped_by"))


def actions(cell: FciCell, ledger: Ledger, count: int, seed: int) -> None:
    """Random actions of any size."""
    from std_msgs.msg import Float64MultiArray

    cell.start("robot", "control")
    link = cell.link
    publisher = link.on_executor(
        lambda: link.node.create_publisher(Float64MultiArray, "/fr3/action", NEWEST)
    )
    dice, fault = np.random.default_rng(seed), ""
    ledger.note("began")
    began_s = time.monotonic()
    way, bias = np.zeros(6), 0.0
    for index in range(count):
        if index % 80 == 0:  # two seconds in one direction reach the edges of the limits
            way, bias = dice.normal(size=6), dice.choice([0.0, 0.7, 0.95])
        direction = bias * way + (1.0 - bias) * dice.normal(size=6)
        size = 10.0 ** (
            dice.uniform(-3.0, -1.7) if dice.random() < 0.8 else dice.uniform(-6.0, 300.0)
        )
        values = np.clip(size * direction / np.linalg.norm(direction), -1e300, 1e300)
        publisher.publish(
            Float64MultiArray(data=[*values.tolist(), float(dice.uniform(-1.0, 2.0))])
        )
        if index % 40 == 0:
            fault = look(cell, ledger, fault)
        due_s = began_s + (index + 1) / ACTION_HZ
        time.sleep(max(0.0, due_s - time.monotonic()))
    cell.record(1.0)
    ledger.note("ended", actions=count, dropped=cell.agent.modules()["control"].get("dropped_by"))


def latencies(ledger: Ledger, factor: float) -> None:
    """From send() of the driver to the first motion, with the control loop idle and running."""
    record = ledger.folder / "record.bin"
    options = (*STRICT, "--no-gripper", "--record", str(record))
    with FrankaSim(PYTHON, seed=1, options=options, log=ledger.folder / "franka-sim.log") as sim:
        driver = open_driver(sim.host, factor)
        try:
            for is_running in (False, True):
                found = latency(driver, sim, record, LATENCY_TRIALS, is_running)
                ledger.note("latency", running=is_running, ms=[round(value, 2) for value in found])
        finally:
            driver.close()


def report_latency(ledger: Ledger) -> int:
    """Print rows of the table; 1 if a trial is missing."""
    for row in ledger.all("latency"):
        loop = "running" if row["running"] else "idle"
        print(
            f"| {len(row['ms'])} times command -> first motion, control loop {loop} before | "
            "median "
            f"{np.median(row['ms']):.1f} ms, worst {max(row['ms']):.1f} ms |"
        )
    for row in ledger.all("broken off"):
        print(f"| broken off | {row['why'][:200]} |")
    return int(len(ledger.all("latency")) < 2)


def report(ledger: Ledger) -> int:
    """Print rows of the table; returns the number of violations and failures."""
    goes = ledger.goes()
    if not goes:
        print("| nothing was measured | |")
        return 1
    loads = ", ".join(f"{row['load']:.1f}" for row in ledger.all("go"))
    realtime = {row["realtime"] for row in ledger.all("look")[-1:] if row.get("realtime")}
    print(
        f"| {ledger.done_s() / 60.0:.1f} minutes in {len(goes)} goes, load before each {loads} on "
        f"{os.cpu_count()} "
        f"cores | {' / '.join(sorted(realtime)) or 'no word of the scheduling'} |"
    )
    faults = Counter(row["fault"].split(":")[0] for row in ledger.all("fault"))
    limits, loops, violations = Limits(), list[Loop](), 0
    for folder, began_s, _ in goes:
        violations += (
            (folder / "franka-sim.log").read_text(errors="replace").count("motion limit violated")
        )
        if (loop := read_go(folder, began_s, limits)) is not None:
            loops.append(loop)
    reflexes = sum(count for fault, count in faults.items() if fault == "reflex")
    print(f"| limits that franka-sim saw violated by a command | {violations} |")
    print(f"| reflexes; faults of the arm | {reflexes}; {dict(faults) or 'none'} |")
    problems = violations + sum(faults.values())
    if broken := ledger.all("broken off"):
        print(f"| broken off {len(broken)} times | {broken[-1]['why'][:200]} |")
        problems += len(broken)
    switches = ledger.all("switch")
    if switches:
        gaps = [row["gap_ms"] for row in switches if row["done"]]
        print(
            f"| warm switches: {len(gaps)} done, {len(switches) - len(gaps)} missed | gap between "
            "actions: median "
            f"{np.median(gaps or [0]):.0f} ms, worst {max(gaps, default=0):.0f} ms |"
        )
    for row in ledger.all("ended"):
        what = (
            f"{row['actions']} random actions at {ACTION_HZ:g} Hz"
            if "actions" in row
            else "the policy's actions"
        )
        print(f"| {what} | control refused: {row['dropped'] or 'none'} |")
    if loops:
        print_loops(loops)
        missed = sum(
            int(
                loop.run_cycles[
                    (loop.run_at_s > row["began_s"])
                    & (loop.run_at_s < row["at_s"] + AFTER_SWITCH_S)
                ].sum()
            )
            for row in switches
            for loop in loops
        )
        lasted_s = sum(row["at_s"] + AFTER_SWITCH_S - row["began_s"] for row in switches)
        print(
            f"| of these, during a switch or within {AFTER_SWITCH_S:g} s after it | {missed}, in "
            f"{lasted_s:.0f} s |"
        )
    looks = ledger.all("look")
    if rates := [row["rate"] for row in looks if row["rate"] > 0.0]:
        print(f"| control success rate | median {np.median(rates):.2f}, worst {min(rates):.2f} |")
    stolen = np.array([row["stolen_s"] for row in looks])
    if len(stolen) > 1:
        steps_ms = np.maximum(np.diff(stolen), 0.0) * 1e3
        print(
            f"| time the hypervisor gave to others | {steps_ms.sum():.0f} ms, "
            f"{steps_ms.max():.0f} ms at the most |"
        )
    problems += limits.print()
    if switches and limits.moving_s < LEAST_MOVING * limits.judged_s:
        print(f"| the arm stood for more than {1.0 - LEAST_MOVING:.0%} of the time | FAILED |")
        problems += 1
    return problems


@contextlib.contextmanager
def beside(count: int) -> Iterator[None]:
    """Busy processes, which end with this one."""
    busy = [subprocess.Popen([sys.executable, "-c", BUSY]) for _ in range(count)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
            process.wait(timeout=20.0)


@contextlib.contextmanager
def broken_off(ledger: Ledger) -> Iterator[None]:
    """Note an error that ends the block; earlier measurements are still evaluated."""
    try:
        yield
    except (RuntimeError, OSError, SystemExit) as error:
        ledger.note("broken off", why=str(error))
        print(f"    broken off: {error}", flush=True)


def run(part: str, ledger: Ledger, busy: int, arguments: argparse.Namespace) -> None:
    """Run the missing trials of this part; an error that ends it early is noted."""
    with beside(busy), broken_off(ledger):
        if part == "latency":
            if len(ledger.all("latency")) < 2:
                latencies(ledger, arguments.factor)
        elif part == "policy":
            if ledger.done_s() < 60.0 * arguments.minutes - 1.0:
                with ledger.go(busy, arguments.factor) as cell:
                    policy(cell, ledger, arguments.minutes, arguments.seed)
        elif not ledger.all("ended"):
            with ledger.go(busy, arguments.factor) as cell:
                actions(cell, ledger, arguments.actions, arguments.seed)


def main() -> int:
    """Run the parts, print rows of the table; 0 without violations and failures."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--actions", type=int, default=10_000)
    parser.add_argument(
        "--busy", default="0,8", help="how many busy processes beside it; several after one another"
    )
    parser.add_argument("--parts", default=",".join(PARTS))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--factor", type=float, default=0.3, help="dynamics_factor; its default is 0.3"
    )
    parser.add_argument("--out", type=Path, default=OUT, help="where everything is written")
    parser.add_argument("--fresh", action="store_true", help="begin anew")
    parser.add_argument("--judge", action="store_true", help="run nothing, print what is there")
    arguments = parser.parse_args()
    parts = arguments.parts.split(",")
    if unknown := set(parts) - set(PARTS):
        parser.error(f"no such part: {', '.join(sorted(unknown))}")
    problems = 0
    for busy in map(int, arguments.busy.split(",")):
        for part in parts:
            ledger = Ledger(
                arguments.out / f"{part}-busy{busy}", arguments.fresh and not arguments.judge
            )
            print(
                f"{part}, {busy} busy processes beside it, dynamics_factor {arguments.factor}, "
                "load average "
                f"{os.getloadavg()[0]:.1f} on {os.cpu_count()} cores",
                flush=True,
            )
            if not arguments.judge:
                run(part, ledger, busy, arguments)
            problems += report_latency(ledger) if part == "latency" else report(ledger)
            sys.stdout.flush()
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
