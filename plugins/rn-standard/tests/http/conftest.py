"""The fakes with this feature: an application in this process without ROS, and servers in processes
of their own.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from rn_standard.http.plugin import FEATURE
from rn_standard.ops.plugin import CLIENTS
from rn_testing.domain import free_ros_domain
from rn_testing.fakes.site import PluginSite
from roboneuron.server.app import Application

sys.path.append(str(Path(__file__).parent))  # for wire_server
MODULES = """
[robot]
name = "gantry"
[perception]
source = "{source}"
[inference]
backend = "instant"
[control]
controller = "gantry"
"""
PLUGIN = """
import threading

from roboneuron import NotReadyError, PerceptionSpec, hookimpl
from rn_testing.fakes import FAKE_BACKEND, FAKE_CONTROLLER, FAKE_PERCEPTION, FAKE_ROBOT


class SilentSource:
    def __init__(self, config, topics, cameras) -> None:
        pass

    def open(self) -> None:
        pass

    def read(self, timeout_s):
        threading.Event().wait(timeout_s)
        raise NotReadyError(f"No frame came within {timeout_s:g} s.")

    def close(self) -> None:
        pass


@hookimpl
def roboneuron_backends():
    return [FAKE_BACKEND]


@hookimpl
def roboneuron_perceptions():
    silent = PerceptionSpec(name="silent", summary="Never delivers.", target="rn_fakes_plugin:SilentSource")
    return [FAKE_PERCEPTION, silent]


@hookimpl
def roboneuron_controllers():
    return [FAKE_CONTROLLER]


@hookimpl
def roboneuron_robots():
    return [FAKE_ROBOT]
"""  # noqa: E501


@pytest.fixture
def application(application_of: Callable[..., Application]) -> Application:
    """The fakes as installed plugins; no ROS is touched until something is started."""
    return application_of(FEATURE, CLIENTS, text=MODULES.format(source="controlled"))


@pytest.fixture
def server_environment(tmp_path: Path) -> dict[str, str]:
    """Environment of a server process that finds the fakes."""
    site = tmp_path / "site"
    PluginSite(path=site).install("rn-fakes", PLUGIN, header="")
    return {**os.environ, "PYTHONPATH": str(site), "ROS_DOMAIN_ID": str(free_ros_domain())}


@pytest.fixture
def serve_command(tmp_path: Path) -> Callable[..., list[str]]:
    """Return a function that writes a configuration and returns the command that serves it."""

    def make(*, source: str = "controlled", start_timeout_s: float = 60.0) -> list[str]:
        path = tmp_path / "roboneuron.toml"
        supervisor = f"start_timeout_s = {start_timeout_s}\nstop_timeout_s = 3.0\n"
        supervisor += f'state_directory = "{tmp_path}/state"\n'
        path.write_text(f"{MODULES.format(source=source)}[supervisor]\n{supervisor}")
        return [
            sys.executable,
            "-m",
            "roboneuron.cli.main",
            "serve",
            "--config",
            str(path),
            "--log-level",
            "warning",
        ]

    return make
