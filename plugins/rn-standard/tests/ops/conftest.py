"""Servers and modules that find the fakes and a ticking camera as an installed plugin."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from rn_testing.domain import free_ros_domain
from rn_testing.fakes.site import PluginSite
from roboneuron.config import Config, parse_config
from roboneuron.supervisor.supervisor import Supervisor

CONFIG = """
[robot]
name = "gantry"
[perception]
source = "ticking"
[inference]
backend = "instant"
[control]
controller = "gantry"
[supervisor]
stop_timeout_s = 3.0
state_directory = "{state}"
"""


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """A folder for PYTHONPATH in which the plugin is installed."""
    folder = tmp_path / "site"
    PluginSite(path=folder).install("rn-ops-tests", "", value="rn_testing.fakes.ticking")
    return folder


@pytest.fixture
def server_environment(site: Path) -> dict[str, str]:
    """Environment of a server process."""
    return {**os.environ, "PYTHONPATH": str(site), "ROS_DOMAIN_ID": str(free_ros_domain())}


@pytest.fixture
def config_text(tmp_path: Path) -> str:
    """A roboneuron.toml of the plugin's parts."""
    return CONFIG.format(state=tmp_path / "state")


@pytest.fixture
def config(config_text: str) -> Config:
    """The same, read."""
    return parse_config(config_text)


@pytest.fixture
def supervisor(tmp_path: Path, site: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Supervisor]:
    """A supervisor of real module processes, closed at the end of the test."""
    monkeypatch.setenv("PYTHONPATH", str(site))
    monkeypatch.setenv("ROS_DOMAIN_ID", os.environ.get("ROS_DOMAIN_ID") or str(free_ros_domain()))
    supervisor = Supervisor(tmp_path / "state")
    try:
        yield supervisor
    finally:
        supervisor.close()
