"""A served FR3 behind franka-sim with both enforcement flags: a policy with warm switches, and random actions.

    python benchmarks/bench_fci_loop.py --minutes 30 --actions 10000 [--load 8] [--parts policy,random]

`policy`: 20 Hz with warm switches at random times; faults, the control box' success rate, and the period of the control
loop by the times at which commands arrived at the simulator. `random`: actions of any size and direction on the action
topic. Both are judged by the joints that the simulator recorded 1000 times per second. Acceleration and jerk are those
of a cubic fitted to 61 ms of positions, where the simulator itself was never late by more than 2 ms: it reads the
commands by a clock of its own, so what it does within a few milliseconds says more of the machine than of the arm.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio

sys.path.insert(0, str(Path(__file__).parent))
from fci_cell import FciCell, Record, served_fci

sys.path.pop(0)

from rn_controller_urdf.collision import CollisionModel
from rn_robot_fr3.description import TCP_LINK, urdf
from rn_robot_fr3.limits import ACCELERATION_RAD_S2, ARM_JOINTS, JERK_RAD_S3, LOWER_RAD, UPPER_RAD, velocity_bounds
from rn_robot_fr3.profile import WORKSPACE_LOWER_M, WORKSPACE_UPPER_M, profile
from roboneuron import JointSample
from roboneuron.ros.qos import NEWEST

WINDOW = 61
STEP_S = 0.001
LATE_S = 0.002
SWITCH_S = (8.0, 25.0)
ACTION_HZ = 50.0
MISSING = 2.0
"""In the simulator's record of commands: it had to extrapolate, for none came in time."""
EVERY = 20
"""Each how many rows the TCP and the distances are computed."""


def fitted(record: Record) -> tuple[Any, Any, float]:
    """Greatest |acceleration| and |jerk| (7,) of cubics through `WINDOW` ms of positions, and the share judged.

    By the times at which the rows were written: the simulator makes up for time that it has lost.
    """
    grid_s = np.arange(record.at_s[0], record.at_s[-1], STEP_S)
    position = np.array([np.interp(grid_s, record.at_s, joint) for joint in record.position.T])
    at_s = (np.arange(WINDOW) - WINDOW // 2) * STEP_S
    fit = np.linalg.pinv(np.stack([np.ones(WINDOW), at_s, at_s**2 / 2.0, at_s**3 / 6.0], axis=1))
    late = np.diff(record.at_s, prepend=record.at_s[0]) > LATE_S
    was_late = np.interp(grid_s, record.at_s, late.astype(float)) > 0.0
    kept = np.convolve(was_late, np.ones(2 * WINDOW + 1), mode="same") < 0.5
    kept[: WINDOW + 1] = kept[-WINDOW - 1 :] = False
    greatest = [[np.abs(np.convolve(q, k[::-1], mode="same"))[kept].max() for q in position] for k in fit[2:]]
    return np.array(greatest[0]), np.array(greatest[1]), float(kept.mean())


def judge(record: Record, what: str) -> int:
    """Print how near the simulator's joints came to each limit; returns how many limits were exceeded."""
    position, velocity = record.position, record.velocity
    lowest, highest = zip(*(velocity_bounds(q) for q in position[::EVERY]), strict=True)
    over_velocity = np.maximum(velocity[::EVERY] - np.array(highest), np.array(lowest) - velocity[::EVERY]).max()
    room = np.minimum(position - np.array(LOWER_RAD), np.array(UPPER_RAD) - position).min()
    acceleration, jerk, kept = fitted(record)
    fastest = float((acceleration / np.array(ACCELERATION_RAD_S2)).max())
    sharpest = float((jerk / np.array(JERK_RAD_S3)).max())
    model = pinocchio.buildModelFromXML(urdf())
    data, frame = model.createData(), model.getFrameId(TCP_LINK)
    robot = profile()
    assert robot.collision is not None
    collisions, outside, pairs = CollisionModel(robot, robot.collision), -np.inf, set()
    for q in position[::EVERY]:
        pinocchio.framesForwardKinematics(model, data, np.append(q, [0.0, 0.0]))
        tcp = data.oMf[frame].translation
        outside = max(outside, float(np.maximum(np.array(WORKSPACE_LOWER_M) - tcp, tcp - WORKSPACE_UPPER_M).max()))
        pairs |= {(p.first, p.second) for p in collisions.near(JointSample(names=ARM_JOINTS, position=q))}
    facts = {
        f"nearest to a joint limit {room:.4f} rad": room < 0.0,
        f"least room to the velocity envelope {-over_velocity:.3f} rad/s": over_velocity > 0.0,
        f"acceleration {fastest:.0%} of 10 rad/s2": fastest > 1.0,
        f"jerk {sharpest:.0%} of 5000 rad/s3": sharpest > 1.0,
        f"TCP at most {outside * 1e3:.1f} mm beyond the workspace (negative: inside)": outside > 0.0,
        f"pairs nearer than allowed: {sorted(pairs) or 'none'}": bool(pairs),
    }
    print(f"| {what}: {len(record.at_s) / 1000:.0f} s of joints, {kept:.0%} of them judged for acceleration | |")
    for fact, is_over in facts.items():
        print(f"| {fact} | {'EXCEEDED' if is_over else 'kept'} |")
    return sum(facts.values())


def status(cell: FciCell, faults: list[str], rates: list[float]) -> None:
    """Take down a fault, and recover."""
    detail = cell.agent.modules()["robot"].get("detail") or {}
    rates.append(float(detail.get("control_success_rate", 0.0)))
    if fault := str(detail.get("fault", "")):
        faults.append(fault)
        print(f"    fault: {fault}", flush=True)
        with contextlib.suppress(RuntimeError):
            cell.agent.do("recover_robot")


def policy(cell: FciCell, minutes: float, seed: int) -> tuple[float, int]:
    """The policy with warm switches; returns when it began, and the number of faults."""
    dice, faults, rates, gaps = random.Random(seed), list[str](), list[float](), list[float]()
    cell.start_policy()
    began_s = time.monotonic()
    end_s = began_s + 60.0 * minutes
    next_s, backend, failed = began_s + dice.uniform(*SWITCH_S), "sway", 0
    while time.monotonic() < end_s:
        time.sleep(0.25)
        status(cell, faults, rates)
        if time.monotonic() < next_s:
            continue
        backend = "swing" if backend == "sway" else "sway"
        try:
            result = cell.agent.do("switch_inference", backend=backend)
            gaps.append(float(result.get("gap_s") or 0.0) * 1e3)
        except RuntimeError as error:
            failed += 1
            backend = "swing" if backend == "sway" else "sway"
            print(f"    switch: {error}", flush=True)
        next_s = time.monotonic() + dice.uniform(*SWITCH_S)
    moving = [rate for rate in rates if rate > 0.0]
    print(f"| {minutes:g} minutes of a policy at 20 Hz | {len(faults)} faults of the arm |")
    print(
        f"| {len(gaps)} warm switches, {failed} failed | gap between actions: median {np.median(gaps or [0]):.0f} ms, "
        f"worst {max(gaps or [0]):.0f} ms |"
    )
    print(f"| control success rate | median {np.median(moving):.2f}, worst {min(moving):.2f} |")
    cell.record(1.0)  # so that what is buffered is written
    commands = np.fromfile(cell.folder / "record.bin.commands").reshape(-1, 11)
    commands = commands[commands[:, 0] > began_s]
    is_missing = np.concatenate([[False], commands[:, 2] == MISSING, [False]])
    runs = np.diff(np.flatnonzero(np.diff(is_missing)))[::2]
    print(f"| cycles without a command | {is_missing.sum()} in {len(runs)} runs, the longest {max(runs, default=0)} |")
    arrivals = commands[commands[:, 2] != MISSING, 0]
    periods = np.diff(arrivals) * 1e3
    periods = periods[periods < 500.0]  # between two motions
    print(
        f"| period of the control loop, by {len(periods)} commands as they arrived | median "
        f"{np.median(periods):.2f} ms, p99 {np.percentile(periods, 99):.2f} ms, longest {periods.max():.1f} ms |",
        flush=True,
    )
    return began_s, len(faults)


def actions(cell: FciCell, count: int, seed: int) -> tuple[float, int]:
    """Random actions of any size; returns when they began, and the number of faults."""
    from std_msgs.msg import Float64MultiArray

    cell.start("robot", "control")
    link = cell.link
    publisher = link.on_executor(lambda: link.node.create_publisher(Float64MultiArray, "/fr3/action", NEWEST))
    dice, faults, rates = np.random.default_rng(seed), list[str](), list[float]()
    began_s = time.monotonic()
    way, bias = np.zeros(6), 0.0
    for index in range(count):
        if index % 80 == 0:  # two seconds in one direction reach the edges of what is allowed
            way, bias = dice.normal(size=6), dice.choice([0.0, 0.7, 0.95])
        direction = bias * way + (1.0 - bias) * dice.normal(size=6)
        size = 10.0 ** (dice.uniform(-3.0, -1.7) if dice.random() < 0.8 else dice.uniform(-6.0, 300.0))
        values = np.clip(size * direction / np.linalg.norm(direction), -1e300, 1e300)
        publisher.publish(Float64MultiArray(data=[*values.tolist(), float(dice.uniform(-1.0, 2.0))]))
        if index % 40 == 0:
            status(cell, faults, rates)
        due_s = began_s + (index + 1) / ACTION_HZ
        time.sleep(max(0.0, due_s - time.monotonic()))
    dropped = cell.agent.modules()["control"].get("dropped_by")
    print(
        f"| {count} random actions at {ACTION_HZ:g} Hz | {len(faults)} faults of the arm; control refused: {dropped} |"
    )
    return began_s, len(faults)


def main() -> int:
    """Run the parts, print rows for docs/fr3.md; 0 when nothing was exceeded and nothing failed."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--actions", type=int, default=10_000)
    parser.add_argument("--load", type=int, default=0, help="busy processes beside it")
    parser.add_argument("--parts", default="policy,random")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--factor", type=float, default=0.3, help="dynamics_factor; its default is 0.3")
    arguments = parser.parse_args()
    print(
        f"load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores, {arguments.load} busy processes beside it, "
        f"dynamics_factor {arguments.factor}"
    )
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(arguments.load)]
    problems = 0
    try:
        for part in arguments.parts.split(","):
            with (
                tempfile.TemporaryDirectory(prefix=f"fci-{part}-") as folder,
                served_fci(Path(folder), factor=arguments.factor) as cell,
            ):
                if part == "policy":
                    began_s, faults = policy(cell, arguments.minutes, arguments.seed)
                else:
                    began_s, faults = actions(cell, arguments.actions, arguments.seed)
                broken = cell.sim_log().count("motion limit violated")
                print(f"| limits that franka-sim saw violated by a command | {broken} |")
                problems += faults + broken + judge(cell.record().since(began_s), part)
    finally:
        for process in busy:
            process.kill()
            process.wait(timeout=20.0)
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
