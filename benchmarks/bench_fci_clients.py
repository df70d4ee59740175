"""Comparison of three client libraries of the FCI: targets at 20 Hz to franka-sim with both
enforcement flags.

    python benchmarks/bench_fci_clients.py --clients DIR/bin/python

DIR is an environment with franky-control==2.0.0, pylibfranka==0.21.3 and franka-rs==0.4.0. Each
client follows the same sine of 0.25 rad on seven joints, alone, and with another Python thread that
holds the interpreter for 50 ms three times per second, like a garbage collection or a slow import.
"aborted" is the simulated robot's own report.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

SECONDS = 10.0
PERIOD_S = 0.05


def franky_client() -> tuple[list[float], Callable[[Any], None], Callable[[], Any]]:
    """C++ thread, ruckig; limits as in rn_robot_fr3.fci.planner."""
    import franky

    robot = franky.Robot("127.0.0.1", realtime_config=franky.RealtimeConfig.Ignore)
    robot.joint_acceleration_limit.set([7.0] * 7)
    robot.joint_jerk_limit.set([2200.0] * 7)

    def aim(target: Any) -> None:
        motion = franky.JointWaypointMotion(
            [franky.JointWaypoint(franky.JointState(target))], return_when_finished=False
        )
        robot.move(motion, asynchronous=True, cutoff_frequency=1000.0)

    def state() -> Any:
        robot.poll_motion()
        return robot.state

    return list(robot.state.q_d), aim, state


def rust_client() -> tuple[list[float], Callable[[Any], None], Callable[[], Any]]:
    """Rust thread with its own planner, 0.5 of the official limits."""
    import franka

    robot = franka.Robot("127.0.0.1", realtime="ignore")
    start = list(robot.read_once().q_d)
    arm = robot.joint_targets(fraction=0.5, max_deviation=6.0, backend="robot")
    return start, lambda target: arm.move_to(list(target)), arm.state


def python_client() -> tuple[list[float], Callable[[Any], None], Callable[[], Any]]:
    """libfranka's bindings: the loop is in Python, with a third-order filter."""
    import numpy as np
    import pylibfranka

    robot = pylibfranka.Robot("127.0.0.1", pylibfranka.RealtimeConfig.kIgnore)
    start = list(robot.read_once().q_d)
    shared: dict[str, Any] = {"target": np.array(start), "state": None, "error": None}

    def loop() -> None:
        position, velocity, acceleration = np.array(start), np.zeros(7), np.zeros(7)
        pole = 12.0
        try:
            control = robot.start_joint_position_control(pylibfranka.ControllerMode.JointImpedance)
            while True:
                shared["state"], _ = control.readOnce()
                jerk = (
                    pole**3 * (shared["target"] - position)
                    - 3 * pole**2 * velocity
                    - 3 * pole * acceleration
                )
                acceleration = acceleration + np.clip(jerk, -2200.0, 2200.0) * 1e-3
                velocity = velocity + acceleration * 1e-3
                position = position + velocity * 1e-3
                control.writeOnce(pylibfranka.JointPositions(position.tolist()))
        except Exception as error:
            shared["error"] = error

    threading.Thread(target=loop, daemon=True).start()
    time.sleep(0.2)

    def state() -> Any:
        if shared["error"] is not None:
            raise shared["error"]
        return shared["state"]

    return start, lambda target: shared.update(target=np.array(target)), state


CLIENTS = {"franky-control": franky_client, "franka-rs": rust_client, "pylibfranka": python_client}


def keep_interpreter() -> None:
    """Holds the interpreter lock for 50 ms, three times per second."""
    end_s = time.monotonic() + 10 * SECONDS
    while time.monotonic() < end_s:
        sys.setswitchinterval(10.0)
        until_s = time.perf_counter() + 0.05
        while time.perf_counter() < until_s:
            sum(range(1000))
        sys.setswitchinterval(0.005)
        time.sleep(0.28)


def one(name: str, paused: bool) -> None:
    """Run one client under one condition; prints a row."""
    import numpy as np

    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(20))
    except OSError:
        print("(not scheduled first in, first out)")
    start, aim, state = CLIENTS[name]()
    if paused:
        threading.Thread(target=keep_interpreter, daemon=True).start()
    began_s, rates, verdict = time.monotonic(), [], "kept moving"
    cpu_s = time.process_time()
    try:
        duration_s = SECONDS
        while (at_s := time.monotonic() - began_s) < duration_s:
            aim(np.array(start) + 0.25 * np.sin(2.2 * at_s) * np.array([1, -1, 1, 1, 1, 1, 1]))
            time.sleep(PERIOD_S)
            seen = state()
            rates.append(float(seen.control_command_success_rate))
            if "reflex" in str(seen.robot_mode).lower():
                raise RuntimeError(f"the robot is in reflex: {seen.last_motion_errors}")
    except Exception as error:
        verdict = (
            f"aborted after {time.monotonic() - began_s:.1f} s: {str(error).splitlines()[0][-90:]}"
        )
    passed_s = time.monotonic() - began_s
    lowest = min(rates[6:], default=0.0)
    cpu = 100 * (time.process_time() - cpu_s) / passed_s
    print(
        f"| {name} | {'50 ms pauses of Python' if paused else 'alone'} | {verdict} | {lowest:.2f} "
        f"| {cpu:.0f} % |",
        flush=True,
    )
    os._exit(0)


def main() -> None:
    """Run every client under both conditions, each with its own process and simulator."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--clients", type=Path, default=Path(sys.executable))
    parser.add_argument("--one", choices=sorted(CLIENTS))
    parser.add_argument("--paused", action="store_true")
    arguments = parser.parse_args()
    if arguments.one:
        one(arguments.one, arguments.paused)
    from rn_robot_fr3.fci.simulator import FrankaSim

    flags = ("--enforce-motion-limits", "--enforce-comm-constraints", "--no-gripper")
    print(f"load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    print(
        "| client | beside it | verdict of franka-sim | lowest success rate | its CPU "
        "|\n|---|---|---|---|---|"
    )
    for name in CLIENTS:
        for paused in ((), ("--paused",)):
            log = Path("out/bench-fci/clients.log")
            with FrankaSim(
                Path(".venv-fr3sim/bin/python"), options=flags, log=log, host="127.0.0.1"
            ):
                command = [str(arguments.clients), __file__, "--one", name, *paused]
                subprocess.run(command, check=False, timeout=120)


if __name__ == "__main__":
    main()
