"""The driver `fci` against franka-sim with both enforcement flags: accuracy, stopping, latency,
load, lost processes.

    make bench-fci ARGS="--targets 500 --stops 100 --stream-s 1800"

All results come from the simulator's own joints. Distances and times are those of this machine.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio

sys.path.insert(0, str(Path(__file__).parent))
from fci_cell import read_record

sys.path.pop(0)

from rn_robot_fr3.description import TCP_LINK, urdf
from rn_robot_fr3.fci.driver import FciDriver
from rn_robot_fr3.fci.options import FciDriverOptions
from rn_robot_fr3.fci.planner import JERK_LIMIT_RAD_S3
from rn_robot_fr3.fci.simulator import FrankaSim
from rn_robot_fr3.limits import ARM_JOINTS
from rn_robot_fr3.profile import HOME_RAD, profile
from rn_testing.fakes import MemoryTopics
from roboneuron import JointCommand

HOME = np.array(HOME_RAD)
STRICT = ("--enforce-motion-limits", "--enforce-comm-constraints")
PARTS = ("targets", "latency", "stops", "stream", "lost")
OUT = Path("out/bench-fci")
PYTHON = Path(".venv-fr3sim/bin/python")
MODEL = pinocchio.buildModelFromXML(urdf())
DATA = MODEL.createData()
TCP = MODEL.getFrameId(TCP_LINK)


def tcp(joints: Any) -> Any:
    """Pose of the TCP for seven joints, fingers closed."""
    pinocchio.framesForwardKinematics(MODEL, DATA, np.append(joints, [0.0, 0.0]))
    return DATA.oMf[TCP].copy()


def open_driver(host: str, factor: float = 0.5) -> FciDriver:
    """A connected driver."""
    options = FciDriverOptions(
        host=host, realtime="ignored", gripper=False, dynamics_factor=factor, watchdog_s=5.0
    )
    driver = FciDriver(options, profile(), MemoryTopics())
    driver.open()
    return driver


def go(driver: FciDriver, target: Any, duration_s: float = 0.1) -> JointCommand:
    """Send a target and serve the watchdog."""
    if fault := driver.read().detail["fault"]:
        print(f"    fault: {fault}", flush=True)
        driver.recover()
    return driver.send(JointCommand(names=ARM_JOINTS, position=target, duration_s=duration_s))


def joints(sim: FrankaSim) -> Any:
    """The simulator's joints."""
    return np.array(sim.tell()["joints"][:7])


def speeds(sim: FrankaSim) -> Any:
    """The simulator's joint velocities."""
    return np.abs(sim.tell()["velocities"])


def wait(driver: FciDriver | None, check: Callable[[], bool], limit_s: float = 20.0) -> float:
    """Wait until `check` holds; returns the time [s]."""
    began_s = time.monotonic()
    end_s = began_s + limit_s
    while not check():
        if time.monotonic() > end_s:
            raise SystemExit(f"not within {limit_s} s: {driver.read().detail if driver else ''}")
        if driver is not None:
            driver.read()
        time.sleep(0.001)
    return time.monotonic() - began_s


def arrived(driver: FciDriver, sim: FrankaSim, target: Any) -> bool:
    """Wait until it stands at the target; False if a fault occurred, from which it recovers."""

    def is_over() -> bool:
        if driver.read().detail["fault"]:
            return True
        return bool(np.abs(joints(sim) - target).max() < 5e-3 and speeds(sim).max() < 1e-3)

    wait(driver, is_over)
    if not (fault := driver.read().detail["fault"]):
        return True
    print(f"    fault: {fault}", flush=True)
    time.sleep(0.5)
    driver.recover()
    return False


def accuracy(driver: FciDriver, sim: FrankaSim, count: int) -> None:
    """Final error of random targets within 5 cm of the last one."""
    random, target, errors, faults = np.random.default_rng(1), HOME, [], 0
    for number in range(1, count + 1):
        while True:
            next_target = HOME + random.uniform(-0.2, 0.2, 7)
            if np.linalg.norm(tcp(next_target).translation - tcp(target).translation) < 0.05:
                break
        target = next_target
        sent = go(driver, target, 0.1)
        time.sleep(min(sent.duration_s, 0.4))
        while not arrived(driver, sim, target):
            faults += 1
            go(driver, target, 0.1)
        time.sleep(0.15)
        off = tcp(joints(sim)).actInv(tcp(target))
        errors.append(
            (
                np.linalg.norm(off.translation) * 1e3,
                np.linalg.norm(pinocchio.log3(off.rotation)) * 1e3,
            )
        )
        if number % 100 and number < count:
            continue
        median, worst = np.median(errors, axis=0), np.max(errors, axis=0)
        print(
            f"| {number} random targets within 5 cm: final TCP error | median {median[0]:.4f} mm, "
            f"{median[1]:.4f} mrad; worst {worst[0]:.4f} mm, {worst[1]:.4f} mrad; {faults} faults "
            "on the way |",
            flush=True,
        )


def stops(driver: FciDriver, sim: FrankaSim, record: Path, count: int) -> None:
    """From hold() to rest, in the simulator's record: time, distance, and motion back
    afterwards.
    """
    random, side, within, rows = np.random.default_rng(2), 1.0, 0, []
    faults = 0
    for _ in range(count):
        target = HOME + side * random.uniform(0.4, 0.8) * np.array([1, 0.4, 0.6, 0.4, 1, 0.6, 1])
        side = -side
        faults += bool(driver.read().detail["fault"])
        go(driver, target, 0.2)
        wait(driver, lambda: bool(speeds(sim).max() > 0.1))
        time.sleep(random.uniform(0.0, 0.45))
        held_s = time.monotonic()
        driver.hold()
        time.sleep(0.6)
        sim.tell(flush=1)
        did = read_record(record, 3.0).since(held_s)
        speed = np.abs(did.velocity[0])
        gone = (did.position - did.position[0]) * np.sign(did.velocity[0])
        # braking at 10 rad/s2, the jerk's ramps, 10 ms from hold() to the robot, and 2 mrad lag of
        # the servo
        allowed = speed**2 / 20.0 + speed * (0.010 + 10.0 / JERK_LIMIT_RAD_S3) + 2e-3
        # the client library limits joint 2 more strictly
        allowed[1] += speed[1] ** 2 * (1.0 / 14.8 - 1.0 / 20.0)
        is_within = bool((gone.max(axis=0) <= allowed).all())
        within += is_within
        rows.append(
            (
                (did.rest_s() - held_s) * 1e3,
                speed.max(),
                (gone.max(axis=0) - gone[-1]).max(where=speed > 0.05, initial=0.0),
            )
        )
    took_ms, speeds_rad_s, back_rad = np.array(rows).T
    print(
        f"| {count} times hold() at {speeds_rad_s.min():.2f} to {speeds_rad_s.max():.2f} rad/s | "
        f"way within what 10 rad/s2 allows (+10 ms): {within} of {count}; "
        f"at rest after {np.median(took_ms):.0f} ms, worst {took_ms.max():.0f} ms; "
        f"goes back {np.median(back_rad) * 1e3:.1f} mrad, worst {back_rad.max() * 1e3:.1f}; "
        f"{faults} faults |",
        flush=True,
    )


def latency(
    driver: FciDriver, sim: FrankaSim, record: Path, count: int, is_running: bool
) -> list[float]:
    """From send() to the simulator's first step in which a joint moves, from its own record [ms].

    `is_running`: True if the control loop is already running, as under a policy; otherwise it must
    be started.
    """
    sent: list[float] = []
    for index in range(count):
        still = (
            (lambda: bool(speeds(sim).max() < 2e-4))
            if is_running
            else (lambda: driver.read().detail["mode"] == "Idle")
        )
        wait(driver, still)
        time.sleep(0.1 + 0.01 * np.random.default_rng(index).random())
        sent.append(time.monotonic())
        go(driver, HOME + 0.1 * (-1) ** index, 0.1)
        wait(driver, lambda: bool(speeds(sim).max() > 0.01))
    sim.tell(flush=1)
    rows = np.fromfile(record)
    rows = rows[: len(rows) // 15 * 15].reshape(-1, 15)
    found = []
    for at_s in sent:
        begin = int(np.searchsorted(rows[:, 0], at_s))
        speed = np.abs(rows[begin : begin + 500, 8:15]).max(axis=1)
        found.append(
            (rows[begin + int(np.argmax(speed > max(2e-4, 2 * speed[0]))), 0] - at_s) * 1e3
        )
    return found


def stream(driver: FciDriver, sim: FrankaSim, limit_s: float, what: str) -> None:
    """Stream targets at 20 Hz; every fault is counted."""
    random, rates, faults, at = np.random.default_rng(3), [], 0, HOME.copy()
    end_s = time.monotonic() + limit_s
    while time.monotonic() < end_s:
        at = np.clip(at + random.uniform(-0.08, 0.08, 7), HOME - 0.5, HOME + 0.5)
        if driver.read().detail["fault"]:
            faults += 1
            print(f"    fault: {driver.read().detail['fault']}", flush=True)
            driver.recover()
        go(driver, at, 0.1)
        time.sleep(0.05)
        rates.append(float(driver.read().detail["control_success_rate"]))
    print(
        f"| {limit_s:.0f} s of random targets at 20 Hz, {what} | {faults} faults; control success "
        "rate: "
        f"worst {min(rates[10:]):.2f}, median {np.median(rates[10:]):.2f} |",
        flush=True,
    )


def child(host: str) -> None:
    """Stream until killed, for at most a minute; for `lost_processes`."""
    driver, step = open_driver(host), 0
    end_s = time.monotonic() + 60.0
    while time.monotonic() < end_s:
        step += 1
        go(driver, HOME + 0.5 * np.sin(0.06 * step) * np.array([1, 0.3, 1, 0.3, 1, 1, 1]), 0.1)
        time.sleep(0.05)


def lost_processes(sim: FrankaSim, log: Path, trials: int) -> None:
    """Motion of the arm when the driver's process is killed or frozen while it moves."""
    for number, name in (
        (signal.SIGKILL, "kill -9"),
        (signal.SIGSTOP, "SIGSTOP"),
        (signal.SIGTERM, "kill"),
    ):
        took_ms, rest, watchdog = list[float](), 0.0, 0
        for _ in range(trials):
            told = len(log.read_bytes())
            process = subprocess.Popen([sys.executable, __file__, "--child", sim.host])
            try:
                time.sleep(3.0)
                wait(None, lambda: bool(speeds(sim).max() > 0.2))
                process.send_signal(number)
                took_ms.append(wait(None, lambda: bool(speeds(sim).max() < 2e-3)) * 1e3)
                time.sleep(0.5)
                rest = max(rest, float(speeds(sim).max()))
            finally:
                process.kill()
                process.wait(timeout=20.0)
            watchdog += b"communication_constraints_violation" in log.read_bytes()[told:]
            time.sleep(2.0)
        print(
            f"| {trials} times {name} of the driver's process while it moves | at rest after "
            f"{np.median(took_ms):.0f} "
            f"ms, worst {max(took_ms):.0f} ms; {watchdog} by the arm's communication watchdog, "
            f"{trials - watchdog} by "
            f"the end of the connection; stays (at most {rest:.4f} rad/s) |",
            flush=True,
        )


def main() -> None:
    """Run all measurements."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--targets", type=int, default=100)
    parser.add_argument("--stops", type=int, default=40)
    parser.add_argument("--trials", type=int, default=30, help="of the latency")
    parser.add_argument("--lost", type=int, default=5, help="how often each process is lost")
    parser.add_argument("--stream-s", type=float, default=60.0)
    parser.add_argument("--load", type=int, default=8, help="busy processes beside it")
    parser.add_argument("--parts", default=",".join(PARTS), help=f"some of {','.join(PARTS)}")
    parser.add_argument("--child", metavar="HOST")
    arguments = parser.parse_args()
    if arguments.child:
        child(arguments.child)
    parts = arguments.parts.split(",")
    log, record = OUT / "franka-sim.log", OUT / "record.bin"
    print(
        f"load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores; franka-sim 1.1.7 "
        f"{' '.join(STRICT)}"
    )
    options = (*STRICT, "--no-gripper", "--record", str(record))
    with FrankaSim(PYTHON, seed=1, options=options, log=log) as sim:
        driver = open_driver(sim.host)
        if "targets" in parts:
            accuracy(driver, sim, arguments.targets)
        if "latency" in parts:
            for is_running in (False, True):
                found = latency(driver, sim, record, arguments.trials, is_running)
                print(
                    f"| {len(found)} times send() -> first motion, control loop "
                    f"{'running' if is_running else 'idle'} "
                    f"before | median {np.median(found):.1f} ms, worst {max(found):.1f} ms |",
                    flush=True,
                )
        if "stops" in parts:
            stops(driver, sim, record, arguments.stops)
        if "stream" in parts:
            stream(driver, sim, arguments.stream_s, "nothing started beside it")
            busy = [
                subprocess.Popen([sys.executable, "-c", "while True: pass"])
                for _ in range(arguments.load)
            ]
            try:
                stream(
                    driver, sim, arguments.stream_s, f"{arguments.load} busy processes beside it"
                )
            finally:
                for process in busy:
                    process.kill()
                    process.wait(timeout=20.0)
        driver.close()
        time.sleep(1.5)
        if "lost" in parts:
            lost_processes(sim, log, arguments.lost)


if __name__ == "__main__":
    main()
