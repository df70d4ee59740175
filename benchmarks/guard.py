"""The hot paths compared with their floors: fails if one of them has become slow.

    python benchmarks/guard.py [--rounds 2]

Each figure is the ratio of RoboNeuron's median to that of a floor that does the same work without
RoboNeuron, interleaved in this run, so that a slow or busy machine raises both. A figure beyond its
bound is measured once more, to exclude the effect of other processes. Exit status 1 if it is beyond
both times. The bounds are about twice the values measured when they were written
(docs/benchmarks.md); the benchmarks named there give exact figures.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import anyio
import bench_direct
import bench_ik
import bench_loop
import bench_spaces
import direct_cell
import numpy as np
import pinocchio
from rich.console import Console
from rich.table import Table

from rn_controller_urdf.ik import InverseKinematics
from rn_controller_urdf.model import build_arm_model
from rn_robot_fr3.profile import profile as fr3_profile
from rn_testing.domain import free_ros_domain
from rn_testing.waiting import wait_for_line
from roboneuron.ros.environment import prepare_environment

FRAMES, CALLS, TARGETS = 90, 60, 150
REPEATS = 5
BARE_NODE = """
import sys
import numpy, pydantic, mcp.server, mcp.types, rclpy
from geometry_msgs.msg import Twist
rclpy.init()
node = rclpy.create_node("floor", namespace="bench")
publisher = node.create_publisher(Twist, "cmd_vel", 10)
print("up", flush=True)
sys.stdin.read()
"""
"""Imports and objects that every server of this kind needs before it can answer."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Guard:
    """One hot path.

    Attributes:
        name: the timed path.
        floor: the compared floor.
        bound: largest ratio.
        measure: returns RoboNeuron's time and the floor's [ms].
    """

    name: str
    floor: str
    bound: float
    measure: Callable[[], tuple[float, float]]


def image_to_action(folder: Path, rounds: int) -> tuple[float, float]:
    """Times of RoboNeuron and of a bare relay, 224 x 224 at 30 Hz [ms]."""
    environment = os.environ | {"PYTHONPATH": str(bench_loop.install(folder))}
    ours: list[float] = []
    floor: list[float] = []
    camera = bench_loop.Camera()
    try:
        for _ in range(rounds):
            for found, peer in (
                (floor, bench_loop.relay(environment)),
                (ours, bench_loop.inference(environment, folder)),
            ):
                with peer:
                    camera.wait_for_peer()
                    found.extend(camera.run(224, 224, FRAMES)[0] * 1e3)
                camera.wait_until_alone()
    finally:
        camera.close()
    return statistics.median(ours), statistics.median(floor)


def call_to_message(folder: Path, endpoints: int) -> tuple[float, float]:
    """Time of RoboNeuron one way, and of an empty tool's way in plus a bare publish [ms]."""
    listener = direct_cell.Listener(folder)
    try:
        with direct_cell.publisher() as publish:
            times = anyio.run(bench_direct.measure, endpoints, CALLS, listener, folder, publish)
    finally:
        listener.close()
    floor = statistics.median(times["entered"]) + statistics.median(times["publish"])
    return statistics.median(times["ours"]), floor


def start_to_message(folder: Path, rounds: int) -> tuple[float, float]:
    """Time from the start of `serve` to its first message, and from that of a bare node to its
    publisher [ms].
    """
    ours: list[float] = []
    floor: list[float] = []
    listener = direct_cell.Listener(folder)
    try:
        for _ in range(rounds + 1):
            begun_s = time.monotonic()
            with subprocess.Popen(
                [sys.executable, "-c", BARE_NODE],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
                env=direct_cell.with_bytecode(),
            ) as process:
                wait_for_line(process.stdout, "up")
                floor.append((time.monotonic() - begun_s) * 1e3)
                process.communicate(timeout=direct_cell.CALL_S)
            ours.append(anyio.run(bench_direct.measure_start, 3, listener, folder)[2] * 1e3)
    finally:
        listener.close()
    return statistics.median(ours), statistics.median(floor)


def inverse_kinematics() -> tuple[float, float]:
    """Time of one solution for the FR3, and of one bare iteration: Jacobian, placement and solve
    [ms].
    """
    robot = fr3_profile()
    assert robot.home_rad is not None
    model = build_arm_model(robot)
    solver = InverseKinematics(model)
    data = model.kinematics.createData()
    random = np.random.default_rng(0)
    damping = np.eye(6) * 1e-8

    def bare(posture: np.ndarray, goal: pinocchio.SE3) -> np.ndarray:
        pinocchio.computeJointJacobians(model.kinematics, data, posture)
        pose = pinocchio.updateFramePlacement(model.kinematics, data, model.tcp_frame)
        jacobian = pinocchio.getFrameJacobian(
            model.kinematics, data, model.tcp_frame, pinocchio.ReferenceFrame.LOCAL
        )
        error = pinocchio.log6(pose.actInv(goal)).vector
        change: np.ndarray = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + damping, error)
        return change

    ours: list[float] = []
    floor: list[float] = []
    for _ in range(TARGETS):
        near = robot.home_rad + random.uniform(-0.5, 0.5, len(model.joints))
        posture = np.clip(near, model.lower, model.upper)
        way_m = bench_ik.random_vector(random, bench_ik.FARTHEST_M)
        way_rad = bench_ik.random_vector(random, bench_ik.FARTHEST_RAD)
        goal = solver.shift(solver.place(posture), way_m, way_rad)
        solve = partial(
            solver.solve, posture, goal, tolerance_m=1e-5, tolerance_rad=1e-4, max_iterations=40
        )
        floor.append(_least_us(partial(bare, posture, goal)) / 1e3)
        ours.append(_least_us(solve) / 1e3)
    return statistics.median(ours), statistics.median(floor)


def joint_space_row() -> tuple[float, float]:
    """Time from answer to command: a row of joint velocities, and one of TCP deltas [ms]."""
    took_ms = bench_spaces.measure(TARGETS)
    return took_ms["joint_velocity"], took_ms["ee_delta"]


def _least_us(call: Callable[[], object]) -> float:
    return min(bench_ik.timed_us(call)[1] for _ in range(REPEATS))


def judge(guards: list[Guard], console: Console) -> bool:
    """Measure all, those beyond their bound twice; True if all are within."""
    table = Table(title="Hot paths beside their floors", title_justify="left")
    for column in ("path", "floor", "ours ms", "floor ms", "ratio", "bound"):
        table.add_column(column, justify="left" if column in ("path", "floor") else "right")
    good = True
    for guard in guards:
        for _ in range(2):
            ours_ms, floor_ms = guard.measure()
            ratio = ours_ms / floor_ms
            if ratio <= guard.bound:
                break
            console.print(f"{guard.name}: {ratio:.2f}, beyond {guard.bound:g}")
        good = good and ratio <= guard.bound
        figures = (f"{ours_ms:.3f}", f"{floor_ms:.3f}", f"{ratio:.2f}", f"{guard.bound:g}")
        table.add_row(guard.name, guard.floor, *figures)
    console.print(table)
    return good


def main() -> int:
    """Measure and check the bounds."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--rounds", type=int, default=2)
    arguments = parser.parse_args()
    os.environ["ROS_DOMAIN_ID"] = str(free_ros_domain())
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        prepare_environment(folder / "log")
        guards = [
            Guard(
                name="image to action, 224 x 224",
                floor="bare rclpy relay",
                bound=2.0,
                measure=partial(image_to_action, folder, arguments.rounds),
            ),
            *(
                Guard(
                    name=f"call to message, {endpoints:,} endpoints",
                    floor="empty tool and bare publish",
                    bound=3.0,
                    measure=partial(call_to_message, folder, endpoints),
                )
                for endpoints in (3, 1000)
            ),
            Guard(
                name="serve to first message",
                floor="bare node with the same libraries",
                bound=3.0,
                measure=partial(start_to_message, folder, arguments.rounds),
            ),
            Guard(
                name="inverse kinematics of the FR3",
                floor="one bare iteration",
                bound=5.0,
                measure=inverse_kinematics,
            ),
            Guard(
                name="joint velocities to command",
                floor="TCP delta to command",
                bound=1.0,
                measure=joint_space_row,
            ),
        ]
        return 0 if judge(guards, Console(width=130)) else 1


if __name__ == "__main__":
    sys.exit(main())
