"""Core with a robot, a controller and a backend serves over stdio: it runs the closed loop,
replaces the policy, derives a tool from a topic's type, moves joints and stops at once.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import anyio
import pytest
from mcp import Client, StdioServerParameters
from mcp.client.stdio import stdio_client

from rn_testing.domain import free_ros_domain
from roboneuron.config import default_text
from roboneuron.plugins.discovery import discover
from roboneuron.plugins.specs import PLUGIN_KINDS

ROOT = Path(__file__).parents[1]
FEATURELESS = (
    "start_robot",
    "start_perception",
    "start_control",
    "start_inference",
    "set_instruction",
    "stop_all",
    "stop_motion",
    "move_joints",
    "look",
    "pick",
)
OPTIONAL = {"run_task", "get_logs", "get_journal", "begin_lead", "start_all"}
"""Tools of features that other distributions bring."""
STATES = """
[[expose]]
name = "states"
kind = "read"
topic = "joint_states"
type = "sensor_msgs/msg/JointState"
summary = "Measured joints."
"""
CORE = "roboneuron-core"
CLOSED_LOOP = ("start_robot", "start_perception", "start_control")


def without_features() -> str:
    """The embedded default without plugins of other distributions that only offer a feature or a
    command, and no device or model.
    """
    by_kind = {
        kind: {o.plugin for o in discover().offers(kind) if o.distribution != CORE}
        for kind in PLUGIN_KINDS
    }
    devices = {
        name
        for kind, names in by_kind.items()
        if kind not in ("feature", "command")
        for name in names
    }
    extending = sorted((by_kind["feature"] | by_kind["command"]) - devices)
    listed = ", ".join(f'"{name}"' for name in extending)
    return f"disabled_plugins = [{listed}]\n{default_text()}\n{STATES}"


async def run_loop(python: str, config: Path, environment: dict[str, str]) -> set[str]:
    """Start everything, replace the policy, read a topic, move a joint, stop at once; return the
    names of the tools.
    """
    words = ["-m", "roboneuron.cli.main", "serve", "--config", str(config), "--log-level", "error"]
    server = StdioServerParameters(command=python, args=words, env=environment)

    async def do(client: Client, tool: str, **arguments: Any) -> Any:
        answer = await client.call_tool(tool, arguments)
        assert not answer.is_error, answer.content
        return answer.structured_content

    async def phases(client: Client) -> set[str]:
        return {m["phase"] for m in (await do(client, "get_status"))["modules"]}

    async with Client(stdio_client(server)) as client:
        names = {tool.name for tool in (await client.list_tools()).tools}
        for tool in CLOSED_LOOP:
            await do(client, tool)
        await do(client, "start_inference", instruction="pick up the red cube")
        assert await phases(client) == {"running"}
        switched = await do(client, "switch_inference", backend="servo")
        assert "servo" in switched["replaced"].values()
        await do(client, "stop_inference")
        await do(client, "read_states")
        await do(client, "move_joints", positions={"fr3_joint1": 0.1}, duration_s=2)
        stopped = await do(client, "emergency_stop", reason="a test")
        assert stopped["latched"]
        await do(client, "stop_all")
    return names


@pytest.mark.ros
@pytest.mark.timeout(180)
def test_the_closed_loop_runs_without_any_other_feature(tmp_path: Path) -> None:
    config = tmp_path / "roboneuron.toml"
    config.write_text(without_features())
    environment = {
        **os.environ,
        "ROS_DOMAIN_ID": str(free_ros_domain()),
        "XDG_STATE_HOME": str(tmp_path),
    }
    names = anyio.run(run_loop, sys.executable, config, environment)
    assert set(FEATURELESS) <= names
    assert names.isdisjoint(OPTIONAL)


@pytest.mark.slow
@pytest.mark.ros
@pytest.mark.timeout(900)
def test_an_environment_with_nothing_but_these_distributions_runs_it_too(tmp_path: Path) -> None:
    """Installs from the package index; run by `make test-all`."""
    venv = tmp_path / "venv"
    subprocess.run([sys.executable, "-m", "venv", str(venv)], check=True)
    python = str(venv / "bin" / "python")
    packages = [
        "roboneuron-core",
        *(
            f"plugins/{n}"
            for n in (
                "rn-robot-fr3",
                "rn-simulation",
                "rn-controller-urdf",
                "rn-backend-servo",
            )
        ),
    ]
    command = [
        python,
        "-m",
        "pip",
        "install",
        "--quiet",
        "--constraint",
        str(ROOT / "constraints.txt"),
    ]
    subprocess.run(
        [*command, *(str(ROOT / package) for package in packages)], check=True, timeout=600
    )
    config = tmp_path / "roboneuron.toml"
    config.write_text(f"{default_text()}\n{STATES}")
    environment = {
        **{
            k: v
            for k, v in os.environ.items()
            if not k.startswith(("ROS", "_ROS", "AMENT", "LD_", "PYTHON"))
        },
        "ROS_DOMAIN_ID": str(free_ros_domain()),
        "XDG_STATE_HOME": str(tmp_path),
    }
    names = anyio.run(run_loop, python, config, environment)
    assert set(FEATURELESS) <= names
    assert names.isdisjoint(OPTIONAL)
