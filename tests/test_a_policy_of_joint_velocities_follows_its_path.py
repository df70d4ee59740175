"""A policy of joint velocities at 15 Hz moves the FR3 along a known joint path, through the real
processes; judged by the TCP.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any

import anyio
import fci_cell
import numpy as np
import pinocchio
import pytest
from fci_plugin import PATH_HZ, PATH_ROWS, path_rad
from mcp import Client
from plugin_site import installed

from rn_robot_fr3.profile import profile
from rn_simulation.engine import ENGINES
from rn_testing.agent import Agent
from rn_testing.fakes import fake_plan
from rn_testing.spinning import spinning_node
from rn_testing.waiting import wait_until
from roboneuron.config import parse_config
from roboneuron.plugins.availability import is_importable
from roboneuron.ros.environment import prepare_environment
from roboneuron.server.app import Application
from roboneuron.supervisor.supervisor import Supervisor
from roboneuron.tools.arm.plugin import LIMITS

F64 = np.ndarray
BESIDE_M = 5e-3
"""Tolerated distance of the TCP from the path."""
END_RAD = 4e-3
"""Tolerated distance of a joint from the end of the path; a lost row is up to 8 mrad."""
CONFIG = """
[robot]
name = "fr3"
[perception]
source = "blank"
cameras = ["front"]
[inference]
backend = "joint-path"
execution = "sequential"
instruction = "trace"
[control]
controller = "urdf"
[supervisor]
start_timeout_s = 60.0
[plugins.fr3]
engine = "{engine}"
"""
PATH_S = PATH_ROWS / PATH_HZ


def tcp_m(joints: F64) -> F64:
    """TCP positions (k, 3) for joints (k, 7), by pinocchio on the robot's description."""
    facts = profile()
    model = pinocchio.buildModelFromXML(facts.urdf)
    data, tcp = model.createData(), model.getFrameId(facts.tcp_link)
    places = []
    for position in joints:
        pinocchio.framesForwardKinematics(model, data, np.append(position, [0.0, 0.0]))
        places.append(np.array(data.oMf[tcp].translation))
    return np.array(places)


def beside_m(joints: F64) -> F64:
    """Distance of the TCP from the nearest point of the path, for each of the postures (k, 7)."""
    path = tcp_m(np.array([path_rad(row) for row in np.linspace(0, PATH_ROWS, 10 * PATH_ROWS)]))
    found: F64 = np.linalg.norm(tcp_m(joints)[:, None] - path[None], axis=2).min(axis=1)
    return found


def check_path(joints: F64) -> None:
    """Check that the whole path was followed, and nothing else."""
    print(f"beside the path: {beside_m(joints).max() * 1e3:.2f} mm at most")
    print(f"at its end: {np.abs(joints[-1] - path_rad(PATH_ROWS)).max() * 1e3:.2f} mrad")
    assert beside_m(joints).max() <= BESIDE_M
    assert np.abs(joints[-1] - path_rad(PATH_ROWS)).max() <= END_RAD
    travelled_m = np.linalg.norm(np.diff(tcp_m(joints), axis=0), axis=1).sum()
    assert travelled_m > 0.5


@dataclass
class Witness:
    """Observations so far, with monotonic times.

    Attributes:
        joints: measured joints of the arm.
        labels: labels of the actions.
    """

    joints: list[tuple[float, ...]] = field(default_factory=list)
    labels: list[tuple[float, str]] = field(default_factory=list)

    def note_action(self, message: Any) -> None:
        """Record a sent action."""
        self.labels.append((time.monotonic(), message.layout.dim[0].label))


@contextmanager
def listening() -> Iterator[Witness]:
    """A separate node that observes actions and joint states."""
    from sensor_msgs.msg import JointState
    from std_msgs.msg import Float64MultiArray

    from roboneuron.ros.qos import NEWEST

    seen = Witness()
    with spinning_node("fr3") as node:
        node.create_subscription(
            JointState,
            "joint_states",
            lambda state: seen.joints.append(tuple(state.position[:7])),
            NEWEST,
        )
        node.create_subscription(Float64MultiArray, "action", seen.note_action, NEWEST)
        yield seen


# Rows that come late because of other load are lost, so nothing may run at the same time.
@pytest.mark.ros
@pytest.mark.timing
@pytest.mark.parametrize("engine", [engine for engine in ENGINES if is_importable(engine)])
def test_the_simulated_fr3_follows_the_path(tmp_path: Path, engine: str) -> None:
    config = parse_config(CONFIG.format(engine=engine))
    with installed(tmp_path, "rn-fci-cell", ("fci_plugin",)):
        prepare_environment(tmp_path / "log")
        supervisor = Supervisor(tmp_path / "state")
        supervisor.on_join = (LIMITS.on_join or "",)
        try:
            with listening() as seen:
                for kind in ("robot", "perception", "control", "inference"):
                    supervisor.start(fake_plan(kind, config))
                wait_until(lambda: at_the_end(supervisor), PATH_S + 20.0, "the path is done")
                count = len(seen.joints)
                wait_until(lambda: len(seen.joints) > count + 20, 5.0, "the arm is measured")
            control = supervisor.view("control").report
            inference = supervisor.view("inference").report
        finally:
            supervisor.close()
    assert control is not None
    assert inference is not None
    assert inference.metrics["space"].startswith("joint_velocity@15:fr3_joint1,")
    assert [key for key in control.metrics if key.startswith("limited.")] == []
    assert control.dropped_by == {}
    check_path(np.array(seen.joints))


def at_the_end(supervisor: Supervisor) -> bool:
    """True if a second of rows after the path was sent."""
    report = supervisor.view("inference").report
    row = 0 if report is None else int(report.metrics.get("chunk_row", "0"))
    return report is not None and report.note == "at the end" and row > PATH_HZ


@pytest.mark.ros
@pytest.mark.timing
@pytest.mark.timeout(150)
def test_it_replaces_a_policy_of_tcp_deltas_while_the_arm_moves(tmp_path: Path) -> None:
    """Then in the other direction; each time at a row boundary."""

    async def scenario(application: Application, seen: Witness) -> None:
        async with Client(application.server) as client:
            do = Agent(client).do

            for kind in ("robot", "perception", "control"):
                await do(f"start_{kind}")
            await do("start_inference", instruction="sway")
            for backend in ("joint-path", "sway"):
                switched = await do("switch_inference", backend=backend)
                assert switched["started_with"]["backend"] == backend
                count = len(seen.labels)
                with anyio.fail_after(10.0):
                    while len(seen.labels) < count + 20:
                        await anyio.sleep(0.05)
            control = next(
                one for one in (await do("get_status"))["modules"] if one["module"] == "control"
            )
            assert control["dropped"] == 0, control
            await do("stop_all")

    config = CONFIG.format(engine="auto").replace('"joint-path"', '"sway"')
    with installed(tmp_path, "rn-fci-cell", ("fci_plugin",)):
        application = Application(parse_config(config), directory=tmp_path / "state")
        try:
            with listening() as seen:
                anyio.run(scenario, application, seen)
        finally:
            application.close()
    kinds = [label.partition("@")[0].partition(":")[0] for _, label in seen.labels]
    assert [kind for kind, _ in groupby(kinds)] == [
        "ee_delta_base",
        "joint_velocity",
        "ee_delta_base",
    ]
    moves = np.abs(np.diff(np.array(seen.joints), axis=0)).max()
    assert moves < 0.05, "no jump between two measurements"


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.timeout(240)
@pytest.mark.skipif(
    not (fci_cell.PYTHON.exists() and is_importable("pylibfranka")),
    reason="franka-sim is not installed: make .venv-fr3sim",
)
def test_the_fr3_behind_its_network_protocol_follows_the_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = 'backend = "joint-path"\nexecution = "sequential"'
    config = fci_cell.CONFIG.replace('backend = "sway"', policy)
    monkeypatch.setattr(fci_cell, "CONFIG", config)
    with fci_cell.served_fci(tmp_path) as cell:
        cell.start("robot", "perception", "control")
        begin_s = time.monotonic()
        cell.agent.do("start_inference", instruction="trace")
        modules: dict[str, Any] = {}

        def is_done() -> bool:
            modules.update(cell.agent.modules())
            metrics = modules["inference"].get("metrics") or {}
            row = int(metrics.get("chunk_row", "0"))
            return modules["inference"].get("note") == "at the end" and row > PATH_HZ

        wait_until(is_done, PATH_S + 30.0, "the path is done")
        joints = cell.record().since(begin_s).position[::20]
        assert cell.fault() == ""
    control = modules["control"]
    assert [key for key in control["metrics"] if key.startswith("limited.")] == []
    check_path(joints)
