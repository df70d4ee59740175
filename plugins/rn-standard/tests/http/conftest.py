"""The fakes with this feature: an application in this process without ROS, and servers in processes
of their own.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from rn_standard.http.plugin import FEATURE
from rn_standard.ops.plugin import CLIENTS
from rn_testing.domain import free_ros_domain
from rn_testing.fakes.site import PluginSite
from roboneuron.server.app import Application

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


def environment_in(folder: Path) -> dict[str, str]:
    """Environment of a server process that finds the fakes, which are installed in `folder`."""
    site = folder / "site"
    PluginSite(path=site).install("rn-fakes", PLUGIN, header="")
    return {**os.environ, "PYTHONPATH": str(site), "ROS_DOMAIN_ID": str(free_ros_domain())}


def command_in(
    folder: Path, *, source: str = "controlled", start_timeout_s: float = 60.0
) -> list[str]:
    """Write a configuration into `folder`; returns the command that serves it."""
    path = folder / "roboneuron.toml"
    supervisor = f"start_timeout_s = {start_timeout_s}\nstop_timeout_s = 3.0\n"
    supervisor += f'state_directory = "{folder}/state"\n'
    path.write_text(f"{MODULES.format(source=source)}[supervisor]\n{supervisor}")
    words = ["serve", "--config", str(path), "--log-level", "warning"]
    return [sys.executable, "-m", "roboneuron.cli.main", *words]


@pytest.fixture
def server_environment(tmp_path: Path) -> dict[str, str]:
    """Environment of a server process that finds the fakes."""
    return environment_in(tmp_path)


@pytest.fixture
def serve_command(tmp_path: Path) -> Callable[..., list[str]]:
    """Return a function that writes a configuration and returns the command that serves it."""
    return partial(command_in, tmp_path)


@pytest.fixture(scope="module")
def shared_folder(
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[Path, list[str], dict[str, str]]:
    """A folder for a server that the tests of a module share, its command and its environment."""
    folder = tmp_path_factory.mktemp("shared")
    return folder, command_in(folder), environment_in(folder)
