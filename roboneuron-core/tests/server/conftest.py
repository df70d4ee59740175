"""An application in this process without ROS, and a site with plugins for servers in separate
processes.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from rn_testing.domain import free_ros_domain
from rn_testing.fakes.site import PluginSite
from roboneuron.plugins.specs import BackendSpec
from roboneuron.server.app import Application

CONFIG = """
[robot]
name = "gantry"
[perception]
source = "{source}"
[inference]
backend = "picky"
[control]
controller = "gantry"
[supervisor]
start_timeout_s = {start_timeout_s}
stop_timeout_s = 3.0
state_directory = "{state}"
"""


@pytest.fixture
def application(application_of: Callable[..., Application]) -> Application:
    """The fakes as installed plugins."""
    text = (
        '[robot]\nname = "gantry"\n[perception]\nsource = "controlled"\n[inference]\nbackend = '
        '"instant"\n'
        '[control]\ncontroller = "gantry"\n'
    )
    heavy = BackendSpec(
        name="heavy", summary="Needs weights.", target="nowhere:Heavy", needs_checkpoint=True
    )
    return application_of(heavy, text=text)


@pytest.fixture
def server_environment(tmp_path: Path) -> dict[str, str]:
    """Environment of a server process that finds the plugin of these tests."""
    site = tmp_path / "site"
    source = Path(__file__).with_name("plugin_for_tests.py").read_text()
    PluginSite(path=site).install("rn-server-tests", source, header="")
    return {**os.environ, "PYTHONPATH": str(site), "ROS_DOMAIN_ID": str(free_ros_domain())}


@pytest.fixture
def serve_command(tmp_path: Path) -> Callable[..., list[str]]:
    """Return a function that writes a configuration and returns the serve command for it."""

    def make(*, source: str = "ticking", start_timeout_s: float = 60.0) -> list[str]:
        path = tmp_path / "roboneuron.toml"
        path.write_text(
            CONFIG.format(source=source, start_timeout_s=start_timeout_s, state=tmp_path / "state")
        )
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
