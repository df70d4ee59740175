"""`switch_inference` from the champion of the cubes policy to a promoted checkpoint while the arm
works, and back with one call.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import anyio
import numpy as np
import pytest

from rn_policy_cubes.checkpoint import CONFIGURATION_FILE, unpack
from rn_policy_cubes.packing import HEAD, Packed
from rn_policy_cubes.weights import shipped_weights
from rn_standard.console.client import spawned_server
from rn_standard.demo.agent import DemoAgent, module_status
from rn_testing.waiting import wait_until
from roboneuron.command import RosLink, qos
from roboneuron.contract import to_ns
from roboneuron.feature import topics
from roboneuron.ros.environment import prepare_environment

torch = pytest.importorskip("torch")
# timing: missed periods depend on the machine's load
pytestmark = [pytest.mark.ros, pytest.mark.timing, pytest.mark.timeout(300)]
INSTRUCTION = "pick up the red cube"
ARM = 7
NOISE = 0.002
"""Noise of a weight of the action head, relative to the weight: a barely different policy."""
MOVED_RAD = 0.02
LARGEST_STEP_RAD, STEP_S = 0.1, 0.05
"""Limit between two measurements that were made at most that far apart, in proportion for others,
since a busy witness misses some; an arm that jumps exceeds it.
"""


@pytest.fixture
def policies(tmp_path: Path) -> tuple[Path, Path]:
    """Folders of the shipped policy and of a slightly different one."""
    shipped = Packed.read(shipped_weights())
    noise = torch.Generator().manual_seed(1)

    def changed(name: str, value: Any) -> Any:
        if not name.startswith(HEAD):
            return value
        return value * (1.0 + NOISE * torch.randn(value.shape, generator=noise))

    tensors = {name: changed(name, value) for name, value in shipped.tensors.items()}
    champion, challenger = tmp_path / "round-0", tmp_path / "round-1"
    unpack(shipped, champion)
    unpack(replace(shipped, tensors=tensors), challenger)
    return champion, challenger


@pytest.fixture
def graph(environment: dict[str, str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A separate ROS graph for this process and the server."""
    for name in ("ROS_DOMAIN_ID", "XDG_STATE_HOME"):
        monkeypatch.setenv(name, environment[name])
    prepare_environment(tmp_path / "log")


@contextmanager
def measured() -> Iterator[list[tuple[float, np.ndarray]]]:
    """Measured positions of the arm [rad], with the time of measurement [s since 1970]."""
    from sensor_msgs.msg import JointState

    seen, link = list[tuple[float, np.ndarray]](), RosLink("onlooker")
    link.open()
    link.subscribe(
        JointState,
        f"/fr3/{topics.JOINT_STATES}",
        lambda message: seen.append(
            (to_ns(message.header.stamp) / 1e9, np.array(message.position[:ARM]))
        ),
        qos.NEWEST,
    )
    try:
        yield seen
    finally:
        link.close()


def test_the_arm_works_on_through_the_promotion_and_the_rollback(
    policies: tuple[Path, Path], graph: None, tmp_path: Path
) -> None:
    champion, challenger = policies
    config = tmp_path / "roboneuron.toml"
    text = (champion / CONFIGURATION_FILE).read_text(encoding="utf-8")
    roots = f'\n[selection]\ncheckpoint_roots = ["{tmp_path}"]\n'
    config.write_text(text + roots, encoding="utf-8")
    anyio.run(play, config, challenger, tmp_path / "server.log")


async def play(config: Path, challenger: Path, log: Path) -> None:
    with measured() as seen:

        async def moves(since_s: float) -> None:
            def is_far() -> bool:
                rows = [row for at_s, row in list(seen) if at_s >= since_s]
                return bool(rows) and float(np.ptp(np.array(rows), axis=0).max()) > MOVED_RAD

            await anyio.to_thread.run_sync(wait_until, is_far, 60.0)

        async with spawned_server(["--config", str(config)], log) as client:
            agent = DemoAgent(client)
            for tool in ("start_robot", "start_perception", "start_control"):
                await agent.call(tool)
            first = await agent.call("start_inference", {"instruction": INSTRUCTION})
            await moves(time.time())
            switched = await agent.call("switch_inference", {"checkpoint": str(challenger)})
            # a cube that was lifted meanwhile is held, so another one is needed for new motion
            await agent.call("set_instruction", {"instruction": "pick up the green cube"})
            await moves(time.time())
            back = await agent.call("switch_inference", {"rollback": True})
            await agent.call("set_instruction", {"instruction": "pick up the blue cube"})
            await moves(time.time())
            status = await agent.status()
            await agent.call("stop_all")
    print(f"promotion: {told(switched)}; rollback: {told(back)}")
    assert dict(switched["started_with"])["checkpoint"] == str(challenger)
    assert dict(switched["replaced"]).get("checkpoint") == dict(first["started_with"]).get(
        "checkpoint"
    )
    assert 0.0 < float(str(switched["difference"])) < 0.05
    assert (switched["missed"], back["missed"]) == (0, 0)
    assert dict(back["started_with"]).get("checkpoint") == dict(first["started_with"]).get(
        "checkpoint"
    )
    assert module_status(status, "inference")["instruction"] == "pick up the blue cube"
    steps = np.abs(np.diff(np.array([row for _, row in seen]), axis=0)).max(axis=1)
    apart_s = np.diff([at_s for at_s, _ in seen])
    assert float((steps / np.maximum(apart_s / STEP_S, 1.0)).max()) < LARGEST_STEP_RAD


def told(switch: dict[str, Any]) -> dict[str, Any]:
    """Measurements of a switch."""
    return {key: switch.get(key) for key in ("gap_s", "period_s", "missed", "difference")}
