"""Servers and modules that find the fakes and a ticking camera as an installed plugin."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from rn_testing.domain import free_ros_domain
from rn_testing.fakes.site import PluginSite

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
[recorder]
images = "lossless"
incident_after_s = 0.5
"""


@pytest.fixture
def clock() -> object:
    """A `recorder_rig.Clock`."""
    from recorder_rig import Clock

    return Clock()


@pytest.fixture
def server_environment(tmp_path: Path) -> dict[str, str]:
    """Environment of a server process with the plugin and a recorder."""
    folder = tmp_path / "site"
    PluginSite(path=folder).install("rn-recorder-tests", "", value="rn_testing.fakes.ticking")
    return {
        **os.environ,
        "PYTHONPATH": str(folder),
        "ROS_DOMAIN_ID": str(free_ros_domain()),
        "ROBONEURON_RECORDER": "on",
    }


@pytest.fixture
def config_path(tmp_path: Path) -> Path:
    """A roboneuron.toml of the plugin's parts."""
    path = tmp_path / "roboneuron.toml"
    path.write_text(CONFIG.format(state=tmp_path / "state"))
    return path
