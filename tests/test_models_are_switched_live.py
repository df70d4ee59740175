"""Perception, control and robot are independent of the model: servo, OpenVLA, OFT with FastV, pi0
in turn.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import anyio
import pytest
from mcp import Client, StdioServerParameters

from rn_standard.demo.agent import DemoAgent
from roboneuron.config import default_text
from roboneuron.ros.environment import prepare_environment

# a minute; test_an_agent_switches_backends.py shows the switch itself
pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(300)]
INSTRUCTION = "pick up the red cube"


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """A tiny random checkpoint in the public layout for each family, created by the plugins' own
    commands.
    """
    made = {}
    for name in ("openvla", "oft", "pi0"):
        made[name] = str(tmp_path_factory.mktemp("checkpoints") / name)
        command = [str(Path(sys.executable).parent / f"roboneuron-{name}"), "make-tiny", made[name]]
        subprocess.run(command, check=True, timeout=120, capture_output=True)
    return made


@pytest.fixture
def graph(
    environment: dict[str, str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Iterator[Any]:
    """A node that observes the server's ROS graph."""
    for key in (
        "ROS_AUTOMATIC_DISCOVERY_RANGE",
        "FASTRTPS_DEFAULT_PROFILES_FILE",
        "AMENT_PREFIX_PATH",
        "ROS_LOG_DIR",
    ):
        monkeypatch.delenv(key, raising=False)
    prepare_environment(tmp_path / "log")
    import rclpy

    context = rclpy.Context()
    context.init(domain_id=int(environment["ROS_DOMAIN_ID"]))
    node = rclpy.create_node("onlooker", context=context)
    yield node
    node.destroy_node()
    context.shutdown()


def contract_topics(graph: Any) -> dict[str, tuple[str, tuple[str, ...]]]:
    """Type and publishers' names of every topic of the contract; the two names of inference count
    as one.
    """
    return {
        name: (
            types[0],
            tuple(
                sorted(
                    {
                        f"{p.node_namespace}/{p.node_name.removesuffix('_b')}"
                        for p in graph.get_publishers_info_by_topic(name)
                    }
                )
            ),
        )
        for name, types in graph.get_topic_names_and_types()
        if name.startswith("/fr3/")
        and not name.split("/")[-1].startswith(("_", "transition_event", "parameter"))
    }


def publishes_actions(topics: dict[str, tuple[str, tuple[str, ...]]]) -> bool:
    return topics.get("/fr3/action") == ("std_msgs/msg/Float64MultiArray", ("/fr3/inference",))


async def seen_in(
    graph: Any, is_right: Callable[[dict[str, tuple[str, tuple[str, ...]]]], bool]
) -> Any:
    """The contract's topics once they are as expected, or after 10 s, because an observer discovers
    endpoints later than modules.
    """
    deadline_s = time.monotonic() + 10.0
    while not is_right(topics := contract_topics(graph)) and time.monotonic() < deadline_s:
        await anyio.sleep(0.05)
    return topics


def process_ids(status: dict[str, Any]) -> dict[str, int]:
    return {m["module"]: m["pid"] for m in status["modules"] if m["module"] != "inference"}


def test_topics_and_processes_stay_while_four_models_take_turns(
    environment: dict[str, str], checkpoints: dict[str, str], graph: Any, tmp_path: Path
) -> None:
    roots = json.dumps([str(Path(path).parent) for path in checkpoints.values()])
    config = tmp_path / "roboneuron.toml"
    config.write_text(
        f"{default_text()}\n[selection]\ncheckpoint_roots = {roots}\n", encoding="utf-8"
    )
    turns: list[dict[str, Any]] = [
        {
            "backend": "openvla",
            "checkpoint": checkpoints["openvla"],
            "options": {"profile": "libero"},
        },
        {
            "backend": "oft",
            "checkpoint": checkpoints["oft"],
            "acceleration": "fastv-p50",
            "options": {"profile": "libero", "constants": "libero", "proprio": True},
        },
        {
            "backend": "pi0",
            "checkpoint": checkpoints["pi0"],
            "options": {"profile": "libero", "cpu_threads": 1},
        },
    ]

    async def play() -> None:
        server = StdioServerParameters(
            command=sys.executable,
            args=["-m", "roboneuron.cli.main", "serve", "--config", str(config)],
            env=environment,
        )
        async with Client(server) as client:
            agent = DemoAgent(client)
            for module in ("robot", "perception", "control"):
                await agent.call(f"start_{module}")
            await agent.call("start_inference", {"instruction": INSTRUCTION})
            topics, processes = (
                await seen_in(graph, publishes_actions),
                process_ids(await agent.status()),
            )
            assert publishes_actions(topics)
            for turn in turns:
                await agent.call("switch_inference", turn)
                status = await agent.status()
                inference = next(m for m in status["modules"] if m["module"] == "inference")
                assert inference["metrics"]["backend"] == turn["backend"]
                assert inference["actions_for_instruction"] > 0
                assert inference["instruction"] == INSTRUCTION
                assert await seen_in(graph, lambda now: now == topics) == topics
                assert process_ids(status) == processes
            await agent.call("stop_all")

    anyio.run(play)
