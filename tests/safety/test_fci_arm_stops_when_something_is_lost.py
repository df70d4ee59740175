"""The FR3 behind its network protocol, moved by a policy, when a process is killed or frozen, or
the network is cut.

Judged by the joint positions that franka-sim records at 1 kHz.
"""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from fci_cell import PYTHON, STILL_RAD_S, FciCell, frozen, served_fci, watched

from roboneuron.plugins.availability import is_importable

pytestmark = [
    pytest.mark.slow,
    pytest.mark.ros,
    pytest.mark.timeout(240),
    pytest.mark.skipif(
        not PYTHON.exists(), reason="franka-sim is not installed: make .venv-fr3sim"
    ),
    pytest.mark.skipif(
        not is_importable("pylibfranka"),
        reason="needs pylibfranka: pip install './plugins/rn-robot-fr3[fci]'",
    ),
]
SERVER_TIMEOUT_S = 1.0
STOP_S = {"control": 2.5, "robot": 1.5, "server": SERVER_TIMEOUT_S + 2.5}
"""Maximum stopping time by failure: the watchdog that acts, the end of the last target, and a
loaded machine.
"""
FASTEST_STOP_RAD_S2 = 60.0
"""Mean over 20 ms. The simulated arm follows an interrupted stream of commands harder than a real
one; a jump is far more.
"""


@pytest.fixture
def cell(tmp_path: Path) -> Iterator[FciCell]:
    with served_fci(tmp_path, server_timeout_s=SERVER_TIMEOUT_S) as made:
        made.start_policy()
        yield made


def stops(cell: FciCell, since_s: float, within_s: float) -> float:
    """Wait until the arm is at rest; return the time since `since_s`. It must not move
    afterwards.
    """

    def rest_s() -> float:
        return cell.record(within_s + 5.0).rest_s()

    assert watched(lambda: time.monotonic() - rest_s() > 0.5, within_s + 5.0), (
        "the arm does not come to rest"
    )
    time.sleep(1.0)  # to show that nothing happens
    record = cell.record(within_s + 10.0)
    took_s = record.rest_s() - since_s
    print(f"at rest after {took_s * 1e3:.0f} ms; simulator: {verdict(cell)}")
    assert took_s < within_s
    assert time.monotonic() - record.rest_s() > 1.0, "it stays at rest"
    after = record.since(since_s)
    mean = np.abs(after.velocity[20:] - after.velocity[:-20]).max(initial=0.0) / 0.020
    assert mean < FASTEST_STOP_RAD_S2, "braking, not a jump"
    return took_s


def verdict(cell: FciCell) -> str:
    """The end of the motion as recorded by the simulated robot."""
    log = cell.sim_log()
    return (
        "communication watchdog"
        if "communication_constraints_violation" in log
        else "motion ended by its client"
    )


@pytest.mark.parametrize("module", ["control", "robot"])
def test_a_killed_module_leaves_an_arm_at_rest(cell: FciCell, module: str) -> None:
    at_s = time.monotonic()
    os.kill(cell.pid(module), signal.SIGKILL)
    stops(cell, at_s, STOP_S[module])
    assert watched(lambda: cell.agent.modules()[module]["health"] == "exited", 10.0)


def test_a_killed_server_leaves_an_arm_at_rest(cell: FciCell) -> None:
    at_s = time.monotonic()
    os.kill(cell.server, signal.SIGKILL)
    stops(cell, at_s, STOP_S["server"])
    assert verdict(cell) == "motion ended by its client", (
        "the driver brakes before its process ends"
    )


@pytest.mark.parametrize("process", ["control", "robot", "server"])
def test_a_frozen_process_leaves_an_arm_at_rest(cell: FciCell, process: str) -> None:
    pid = cell.server if process == "server" else cell.pid(process)
    at_s = time.monotonic()
    with frozen(pid):
        stops(cell, at_s, STOP_S[process])
        assert verdict(cell) == "motion ended by its client", "the driver brakes by itself"


def network() -> str:
    """Reason why no separate network is possible here; empty if it is."""
    if os.geteuid() != 0:
        return "needs the rights to make a network namespace"
    made = subprocess.run(["unshare", "-n", "ip", "link"], capture_output=True, check=False)
    return "" if made.returncode == 0 else "this machine makes no network namespaces"


HERE, THERE = "10.213.37.1", "10.213.37.2"


@pytest.fixture
def cut_cell(tmp_path: Path) -> Iterator[tuple[FciCell, str]]:
    """A cell whose simulator is behind a separate cable, and the cable's name; both are removed
    with the namespace.
    """
    if reason := network():
        pytest.skip(reason)
    holder = subprocess.Popen(["unshare", "-n", "sleep", "600"])
    cable, inside = f"fr3a{os.getpid()}", ["nsenter", "-t", str(holder.pid), "-n"]
    try:
        assert watched(
            lambda: os.readlink(f"/proc/{holder.pid}/ns/net") != os.readlink("/proc/self/ns/net"),
            5.0,
        )
        for command in (
            [
                "ip",
                "link",
                "add",
                cable,
                "type",
                "veth",
                "peer",
                "name",
                "fr3b",
                "netns",
                str(holder.pid),
            ],
            ["ip", "addr", "add", f"{HERE}/30", "dev", cable],
            ["ip", "link", "set", cable, "up"],
            [*inside, "ip", "addr", "add", f"{THERE}/30", "dev", "fr3b"],
            [*inside, "ip", "link", "set", "fr3b", "up"],
        ):
            subprocess.run(command, check=True)
        with served_fci(tmp_path, host=THERE, prefix=inside) as made:
            made.start_policy()
            yield made, cable
    finally:
        holder.kill()
        holder.wait(10.0)


def test_a_cut_network_leaves_an_arm_at_rest_until_a_person_recovers_it(
    cut_cell: tuple[FciCell, str],
) -> None:
    cell, cable = cut_cell
    at_s = time.monotonic()
    subprocess.run(["ip", "link", "set", cable, "down"], check=True)
    stops(cell, at_s, 2.0)
    assert verdict(cell) == "communication watchdog"
    assert watched(lambda: cell.fault().startswith("communication_lost"), 20.0), (
        cell.agent.modules()["robot"]
    )
    with pytest.raises(RuntimeError, match="communication_lost"):
        cell.agent.do("recover_robot")
    subprocess.run(["ip", "link", "set", cable, "up"], check=True)
    cell.agent.do("stop_inference")
    assert watched(lambda: _recovers(cell), 20.0)
    assert cell.speed() < STILL_RAD_S, "nothing moves by itself"
    cell.agent.do("start_inference", instruction="sway")
    assert watched(lambda: cell.speed() > 5 * STILL_RAD_S, 20.0), "it moves again"


def _recovers(cell: FciCell) -> bool:
    try:
        cell.agent.do("recover_robot")
    except RuntimeError:
        return False
    return True
