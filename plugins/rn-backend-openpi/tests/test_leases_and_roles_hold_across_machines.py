"""Agents on the machines of a robot and of its policies (network namespaces): who may start and
switch a policy, what ends when its operator stops sending heartbeats or the cable is cut, that
nothing moves afterwards without a new start, and that a running task moves from one machine to
another by its name. Needs root.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from far_agent import FarAgent
from link_machines import Machine, Talker, impossible, machines
from policy_servers import FarServer, pair

from rn_testing.waiting import wait_until

pytestmark = [
    pytest.mark.ros,
    pytest.mark.slow,
    pytest.mark.timeout(600),
    pytest.mark.skipif(bool(impossible()), reason=impossible() or "possible"),
]
WATCHER = Path(__file__).parents[2] / "rn-link" / "tests" / "link_watcher.py"
PORT, LEASE_S = 8765, 20.0
ROLES = {"ann": "admin", "bob": "operator", "eve": "viewer"}
REFLEX = {"rows": 16, "step_s": 0.1, "gain": 0.00004}
CONFIG = f"""
[server]
transport = "http"
reset_emergency_stop = "client"
[http]
host = "0.0.0.0"
port = {PORT}
allowed_hosts = ["ROBOT"]
lease_s = {LEASE_S}
lease_streams = false
[robot]
name = "fr3"
[perception]
source = "fr3-sim-camera"
[control]
controller = "urdf"
[plugins]
fr3-sim-camera = {{ width = 64, height = 64 }}
reflex = {{ {", ".join(f"{key} = {value}" for key, value in REFLEX.items())} }}
[models.one]
backend = "reflex"
host = "gpu"
fallback = "reflex"
[models.other]
backend = "reflex"
host = "gpu"
[hosts.gpu]
address = "gpu:7420"
options = {{ timeout_s = 0.4 }}
[hosts.attic]
address = "attic:7420"
options = {{ timeout_s = 0.4 }}
""" + "".join(
    f'[[http.tokens]]\nname = "{name}"\nrole = "{role}"\nvariable = "TEST_{name.upper()}"\n'
    for name, role in ROLES.items()
)
TOKENS = {name: f"the-token-of-test-{name}" for name in ROLES}
MOVED_RAD, STILL_RAD = 0.003, 0.0005
LOOK_S = 2.0


@dataclass
class Lab:
    """The machines, their processes, and the joints of the arm.

    Attributes:
        machines: `gpu` and `attic`, each with a policy server.
        ann: at the robot, with all rights.
        bob, eve: at the machine `gpu`; an operator and a viewer.
    """

    machines: dict[str, Machine]
    servers: dict[str, FarServer]
    watcher: Talker
    ann: FarAgent
    bob: FarAgent
    eve: FarAgent

    @property
    def gpu(self) -> Machine:
        """The machine with the policy."""
        return self.machines["gpu"]

    def start(self, agent: FarAgent, host: str = "gpu") -> None:
        """Let an agent become the operator, and let the policy on another machine move the arm."""
        agent.beat()
        for tool in ("start_robot", "start_perception", "start_control"):
            agent.do(tool)
        agent.do("start_inference", model="one", host=host, instruction="go on")
        wait_until(lambda: self.watcher.report().get("positions"), 60.0, "the arm is measured")
        self.wait_until_it_moves()
        self.wait_until_it_asks(host)

    def moved_rad(self, within_s: float = LOOK_S) -> float:
        """Motion of the joint that moves most within this time [rad]."""
        first = self.watcher.report()
        time.sleep(within_s)
        then = self.watcher.report()
        assert then["joint_states"] > first["joint_states"], "the arm is measured"
        return float(np.abs(np.subtract(then["positions"], first["positions"])).max())

    def wait_until_it_moves(self, timeout_s: float = 60.0) -> None:
        """Wait for motion of the arm."""
        wait_until(lambda: self.moved_rad() > MOVED_RAD, timeout_s, "the arm moves")

    def wait_until_it_stands(self, timeout_s: float) -> None:
        """Wait for the arm to rest."""
        wait_until(lambda: self.moved_rad() < STILL_RAD, timeout_s, "the arm stands")

    def check_nothing_moves(self) -> None:
        """Check for a while that nothing moves."""
        asked = self.asked()
        assert self.moved_rad(4.0) < STILL_RAD, "nobody has asked for motion"
        assert self.asked() == asked, "nor is the policy asked"

    def asked(self, host: str = "gpu") -> int:
        """Number of requests answered by the policies on another machine."""
        models = self.servers[host].status()["models"]
        return sum(int(model["batches"]) for model in models.values())

    def wait_until_it_asks(self, host: str = "gpu") -> None:
        """Wait for the robot to use another machine, while the third one rests."""
        (third,) = self.machines.keys() - {host}
        before, resting = self.asked(host), self.asked(third)
        wait_until(lambda: self.asked(host) > before + 5, 60.0, f"{host} is asked")
        assert self.asked(third) - resting <= 1
        assert f'"host": "{host}"' in json.dumps(self.ann.do("get_status"))

    def inference(self, agent: FarAgent) -> dict[str, Any]:
        """Status of the inference module."""
        modules = agent.do("get_status", details=True)["modules"]
        found: dict[str, Any] = next(one for one in modules if one["module"] == "inference")
        return found

    def wait_for_the_fallback(self, agent: FarAgent) -> None:
        """Wait until the policy of this machine acts."""
        wait_until(
            lambda: self.inference(agent)["metrics"].get("fallback.acting") == "reflex",
            30.0,
            f"the fallback acts: {self.inference(agent)}",
        )


@contextmanager
def served_robot(robot: Machine, site: str) -> Iterator[str]:
    """`roboneuron serve` on the robot's machine; the URL."""
    config = robot.state / "roboneuron.toml"
    config.write_text(CONFIG.replace("ROBOT", robot.address))
    words = ["-m", "roboneuron.cli.main", "serve", "--config", str(config), "--log-level", "error"]
    variables = {f"TEST_{name.upper()}": token for name, token in TOKENS.items()}
    with (robot.state / "server.log").open("wb") as log:
        process = subprocess.Popen(
            robot.inside(sys.executable, *words),
            env={**os.environ, "XDG_STATE_HOME": str(robot.state), "PYTHONPATH": site, **variables},
            stdin=subprocess.DEVNULL,
            stderr=log,
        )
    try:
        yield f"http://{robot.address}:{PORT}/mcp"
    finally:
        process.terminate()
        try:
            process.wait(60.0)
        finally:
            process.kill()
            process.wait(10.0)


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[Lab]:
    with machines(tmp_path, "robot", "gpu", "attic") as made, ExitStack() as stack:
        robot, servers = made.pop("robot"), {}
        models = {name: {"options": REFLEX} for name in ("one", "other")}
        for name, machine in made.items():
            pair(robot.state, machine.state, name=name, address=machine.address)
            folder = tmp_path / name[0]  # short enough for the path of a socket
            folder.mkdir()
            listen = {"host": "0.0.0.0", "port": 7420}
            server = servers[name] = FarServer(folder, models, listen, machine.state)
            server.machine = machine
            stack.callback(server.end)
            server.start()
        path = os.pathsep.join(filter(None, (str(folder / "site"), os.environ.get("PYTHONPATH"))))
        url = stack.enter_context(served_robot(robot, path))
        wait = f"until (exec 3<>/dev/tcp/{robot.address}/{PORT}) 2>&-; do sleep 0.1; done"
        subprocess.run(made["gpu"].inside("bash", "-c", wait), check=True, timeout=60.0)
        agents = {
            name: FarAgent(robot if name == "ann" else made["gpu"], url, token)
            for name, token in TOKENS.items()
        }
        for agent in agents.values():
            stack.callback(agent.close)
        watcher = robot.talk("watcher", script=WATCHER)
        yield Lab(made, servers, watcher, **agents)


def test_one_operator_holds_the_policy_of_another_machine_while_it_is_heard_of(lab: Lab) -> None:
    lab.start(lab.ann)

    for tool in ("start_inference", "switch_inference"):
        said = lab.bob.fail(tool, model="other", host="gpu")
        assert "'ann' operates the robot" in said, said
        assert "role" in lab.eve.fail(tool, model="other", host="gpu")
    assert "'ann' operates" in lab.bob.fail("set_instruction", instruction="something else")
    assert lab.inference(lab.eve)["phase"] == "running", "whoever may not act may look"
    lab.wait_until_it_asks()
    lab.wait_until_it_moves()

    lab.ann.rest()
    wait_until(
        lambda: lab.inference(lab.bob)["phase"] == "stopped",
        LEASE_S + 10.0,
        "the policy is stopped",
    )
    lab.wait_until_it_stands(5.0)
    lab.check_nothing_moves()

    lab.bob.beat()
    lab.bob.do("start_inference", model="other", host="gpu", instruction="go on")
    lab.wait_until_it_moves()
    lab.wait_until_it_asks()
    assert "'bob' operates the robot" in lab.ann.fail("switch_inference", model="one", host="gpu")


def test_neither_a_lapsed_lease_nor_a_stop_needs_the_cable_and_nothing_moves_with_its_return(
    lab: Lab,
) -> None:
    lab.start(lab.bob)
    lab.gpu.cut()
    lab.wait_for_the_fallback(lab.ann)
    wait_until(
        lambda: lab.inference(lab.ann)["phase"] == "stopped",
        LEASE_S + 10.0,
        "nothing is heard of the operator, who is behind the cable",
    )
    lab.wait_until_it_stands(5.0)
    lab.gpu.plug()
    lab.check_nothing_moves()
    lab.bob.close()

    lab.ann.beat()
    lab.ann.do("start_inference", model="one", host="gpu", instruction="go on")
    lab.wait_until_it_moves()
    lab.wait_until_it_asks()
    lab.gpu.cut()
    lab.wait_for_the_fallback(lab.ann)
    lab.wait_until_it_moves()
    stopped = lab.ann.do("emergency_stop", reason="to be seen while the cable is cut")
    assert set(stopped["confirmed_by"]) == {"robot", "perception", "inference", "control"}
    lab.wait_until_it_stands(5.0)
    lab.gpu.plug()
    lab.check_nothing_moves()
    lab.ann.do("reset_emergency_stop")
    lab.check_nothing_moves()
    lab.ann.do("set_instruction", instruction="go on")
    lab.wait_until_it_moves()
    lab.wait_until_it_asks()


def test_a_running_task_moves_between_machines_and_stays_where_the_other_is_out_of_reach(
    lab: Lab,
) -> None:
    lab.start(lab.ann, "attic")
    missed = []
    for name in ("gpu", "attic", "gpu"):
        switched = lab.ann.do("switch_inference", model="one", host=name)
        assert switched["mode"] == "warm"
        missed.append(switched["missed"])
        lab.wait_until_it_asks(name)
        lab.wait_until_it_moves()
    assert min(missed) == 0, missed
    assert max(missed) <= 1, "a busy machine may cost one"
    lab.machines["attic"].cut()
    assert "attic" in lab.ann.fail("switch_inference", model="one", host="attic")
    before = lab.asked()
    wait_until(lambda: lab.asked() > before + 5, 30.0, "gpu goes on")
    lab.wait_until_it_moves()
