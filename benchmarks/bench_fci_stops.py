"""The emergency stop of a served FR3 behind franka-sim, by tool, topic and file, from random
speeds.

    python benchmarks/bench_fci_stops.py --trials 100

One line of out/bench-fci/stops.jsonl per trial; an interrupted run can be resumed (--fresh starts
again). The joints of the simulator are recorded 1000 times per second. Each trial is evaluated
separately:

- reaction: from triggering the stop to the time from which the fastest joint only decelerates;
- braking: from then to rest. Each joint may take its speed / 10 rad/s2, the ramps of a jerk of 1800
  rad/s3 at both ends and `SERVO_S`, in which the simulated servo follows.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from fci_cell import HOME, STILL_RAD_S, FciCell, Record, served_fci, watched

sys.path.pop(0)

from rn_robot_fr3.fci.planner import JERK_LIMIT_RAD_S3
from roboneuron.estop import ESTOP_FILE, EmergencyStopLatch
from roboneuron.ros.qos import LATCHED

OUT = Path("out/bench-fci/stops.jsonl")
WAYS = ("tool", "topic", "file")
ALLOWED_RAD_S2 = 10.0
RAMPS_S = 2 * ALLOWED_RAD_S2 / float(JERK_LIMIT_RAD_S3[0])
SERVO_S = 0.04
"""kd / kp of franka-sim's position servo is 0.1 s: its final lag vanishes within this time."""
CENTRE_RAD = HOME + np.array([0.0, 0.5, 0.0, 0.45, 0.0, 0.1, 0.0])
"""Centre of the workspace."""
AMPLITUDE_RAD = np.array([0.35, 0.08, 0.25, 0.1, 0.6, 0.2, 1.1])
DIRECT_S = (1.0, 2.2)


def presses(cell: FciCell) -> dict[str, Callable[[], object]]:
    """Ways to trigger the stop."""
    from std_msgs.msg import Bool

    publisher = cell.link.on_executor(
        lambda: cell.link.node.create_publisher(Bool, "/fr3/emergency_stop", LATCHED)
    )
    latch = EmergencyStopLatch(cell.folder / "state" / ESTOP_FILE, time.time_ns)
    return {
        "tool": lambda: cell.agent.do("emergency_stop", reason="trial"),
        "topic": lambda: publisher.publish(Bool(data=True)),
        "file": lambda: latch.press(who="trial", reason="trial"),
    }


def braking(record: Record, pressed_s: float) -> tuple[float, float]:
    """Times at which, after the stop, the fastest joint began to only decelerate, and at which the
    arm was at rest.
    """
    speed = np.abs(record.velocity).max(axis=1)
    window = 5
    smooth = np.convolve(speed, np.ones(window) / window, mode="same")
    end = int(np.searchsorted(record.at_s, record.rest_s()))
    begin = end
    while begin > 0 and record.at_s[begin] > pressed_s and smooth[begin - 1] > smooth[begin] - 1e-3:
        begin -= 1
    return float(record.at_s[begin]), float(record.rest_s())


def trial(
    cell: FciCell, press: Callable[[], object], way: str, random: np.random.Generator, side: int
) -> dict[str, Any] | None:
    """One stop during a `move_joints`; None if it had already arrived."""
    target = CENTRE_RAD + side * AMPLITUDE_RAD * random.uniform(0.7, 1.0)
    duration_s = random.uniform(*DIRECT_S)
    wanted = random.uniform(0.2, 0.8) * float(np.abs(target - cell.position()).max()) / duration_s
    cell.move(target, duration_s)
    watched(lambda: cell.speed() > wanted, 2.5)
    if cell.speed() < 5 * STILL_RAD_S:
        raise SystemExit(f"the arm did not move: {cell.refusal or cell.fault()}")
    pressed_s = time.monotonic()
    press()
    answered_s = time.monotonic()
    if not watched(lambda: cell.speed() < STILL_RAD_S, 5.0):
        raise SystemExit(f"the arm did not stop: {cell.agent.modules()['robot']}")
    time.sleep(0.4)
    record = cell.record(6.0).since(pressed_s - 0.02)
    if record.rest_s() <= pressed_s:
        return None
    begun_s, rest_s = braking(record, pressed_s)
    at = int(np.searchsorted(record.at_s, begun_s))
    speeds = np.abs(record.velocity[at])
    allowed_s = float(speeds.max()) / ALLOWED_RAD_S2 + RAMPS_S + SERVO_S
    late_ms = float(np.diff(record.since(begun_s, rest_s).at_s, prepend=begun_s).max() * 1e3)
    return {
        "way": way,
        "speed_rad_s": round(float(speeds.max()), 4),
        "joint": int(speeds.argmax()) + 1,
        "reaction_ms": round((begun_s - pressed_s) * 1e3, 1),
        "braking_ms": round((rest_s - begun_s) * 1e3, 1),
        "allowed_ms": round(allowed_s * 1e3, 1),
        "answered_ms": round((answered_s - pressed_s) * 1e3, 1),
        "way_rad": round(float(np.abs(record.position[-1] - record.position[at]).max()), 5),
        "simulator_late_ms": round(late_ms, 1),
        "within": rest_s - begun_s <= allowed_s,
        "fault": cell.fault(),
    }


def run(folder: Path, rows: list[dict[str, Any]], trials: int, out: Path) -> None:
    """Run the missing trials."""
    with served_fci(folder) as cell:
        cell.start("robot")
        cell.move(CENTRE_RAD, 3.0).join(60.0)
        ways = presses(cell)
        while len(rows) < trials:
            way = WAYS[len(rows) % len(WAYS)]
            random = np.random.default_rng(len(rows))
            side = 1 if cell.position()[6] < CENTRE_RAD[6] else -1
            row = trial(cell, ways[way], way, random, side)
            # so that all modules agree before it is released
            cell.agent.do("emergency_stop", reason="trial")
            cell.agent.do("reset_emergency_stop")
            if cell.fault():
                cell.agent.do("recover_robot")
            if row is None:
                continue
            rows.append(row)
            with out.open("a") as lines:
                lines.write(json.dumps(row) + "\n")
            print(row, flush=True)


def table(rows: list[dict[str, Any]]) -> None:
    """Print rows of the table."""
    print(
        "| by | trials | speed rad/s | reaction ms, median / worst | braking ms, median / worst | "
        "within | faults |"
    )
    print("|---|---|---|---|---|---|---|")
    for way in WAYS:
        some = [row for row in rows if row["way"] == way]
        if not some:
            continue
        speed, reaction, brake = (
            np.array([r[k] for r in some]) for k in ("speed_rad_s", "reaction_ms", "braking_ms")
        )
        print(
            f"| {way} | {len(some)} | {speed.min():.2f} .. {speed.max():.2f} | "
            f"{np.median(reaction):.0f} / "
            f"{reaction.max():.0f} | {np.median(brake):.0f} / {brake.max():.0f} | "
            f"{sum(r['within'] for r in some)} | {sum(bool(r['fault']) for r in some)} |"
        )


def main() -> int:
    """Run, and print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--trials", type=int, default=100)
    parser.add_argument("--fresh", action="store_true")
    parser.add_argument("--out", type=Path, default=OUT)
    arguments = parser.parse_args()
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    if arguments.fresh:
        arguments.out.unlink(missing_ok=True)
    rows = (
        [json.loads(line) for line in arguments.out.read_text().splitlines()]
        if arguments.out.exists()
        else []
    )
    print(
        f"load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores; {len(rows)} trials "
        "done before",
        flush=True,
    )
    if len(rows) < arguments.trials:
        with tempfile.TemporaryDirectory(prefix="fci-stops-") as folder:
            run(Path(folder), rows, arguments.trials, arguments.out)
    table(rows)
    return 0 if all(row["within"] and not row["fault"] for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
