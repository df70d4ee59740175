"""Core with a robot, a controller, a backend and the features of the closed loop runs it over
stdio; every other feature is left out.
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
)
LOOP_FEATURES = {
    "rn-control",
    "rn-inference",
    "rn-perception",
    "rn-serve-stdio",
    "rn-tools-loop",
}
"""They provide three of the modules, the transport, and the start tools."""
CLOSED_LOOP = ("start_robot", "start_perception", "start_control")


def without_features(distribution: str = "") -> str:
    """The embedded default without plugins that only offer a feature or a command, and no device,
    model or part of the loop.

    Args:
        distribution: only its plugins are disabled; empty for all installed ones.
    """
    by_kind = {
        kind: {o.plugin for o in discover().offers(kind) if distribution in ("", o.distribution)}
        for kind in PLUGIN_KINDS
    }
    devices = {
        name
        for kind, names in by_kind.items()
        if kind not in ("feature", "command")
        for name in names
    }
    extending = sorted((by_kind["feature"] | by_kind["command"]) - devices - LOOP_FEATURES)
    listed = ", ".join(f'"{name}"' for name in extending)
    return f"disabled_plugins = [{listed}]\n{default_text()}"


async def run_loop(python: str, config: Path, environment: dict[str, str]) -> set[str]:
    """Start everything and run the first seconds of picking up the cube; return the names of the
    tools.
    """
    words = ["-m", "roboneuron.cli.main", "serve", "--config", str(config), "--log-level", "error"]
    server = StdioServerParameters(command=python, args=words, env=environment)

    async def do(client: Client, tool: str, **arguments: Any) -> Any:
        answer = await client.call_tool(tool, arguments)
        assert not answer.is_error, answer.content
        return answer.structured_content

    async with Client(stdio_client(server)) as client:
        names = {tool.name for tool in (await client.list_tools()).tools}
        for tool in CLOSED_LOOP:
            await do(client, tool)
        await do(client, "start_inference", instruction="pick up the red cube")
        modules = (await do(client, "get_status"))["modules"]
        assert {m["module"]: m["phase"] for m in modules} == dict.fromkeys(
            ("robot", "perception", "inference", "control"), "running"
        )
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
    assert not [
        name
        for name in names
        if name.startswith(("switch_", "publish_", "move_")) or name == "get_logs"
    ]


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
                "rn-standard",
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
    config.write_text(without_features("rn-standard"))
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
    assert "get_logs" not in names
