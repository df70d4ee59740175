"""A server of its own process with its view switched on by the command line, as a client on stdio
sees it.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
from anyio.from_thread import start_blocking_portal
from view_page import wait_until

from rn_standard.console.client import spawned_server
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
state_directory = "{state}"
[view]
port = 0
"""
Call = Callable[..., dict[str, Any]]


@contextmanager
def served_view(folder: Path) -> Iterator[tuple[Call, str]]:
    """Run `roboneuron serve --view` with the fakes; gives a function that calls its tools, and the
    address of its page.
    """
    PluginSite(path=folder / "site").install("rn-view-tests", "", value="rn_testing.fakes.ticking")
    config, log = folder / "roboneuron.toml", folder / "server.log"
    config.write_text(CONFIG.format(state=folder / "state"))
    with pytest.MonkeyPatch.context() as patch, ExitStack() as stack:
        patch.setenv("PYTHONPATH", str(folder / "site"))
        patch.setenv("ROS_DOMAIN_ID", str(free_ros_domain()))
        portal = stack.enter_context(start_blocking_portal())
        server = spawned_server(["--view", "--config", str(config)], log)
        client = stack.enter_context(portal.wrap_async_context_manager(server))

        def call(tool: str, **arguments: Any) -> dict[str, Any]:
            answer = portal.call(client.call_tool, tool, arguments)
            assert not answer.is_error, answer.content
            return dict(answer.structured_content or {})

        def address() -> list[str]:
            return re.findall(r"live view is at (http://[\d.]+:\d+)", log.read_text())

        wait_until(lambda: bool(address()))
        yield call, address()[0]


@contextmanager
def attached_view(folder: Path) -> Iterator[str]:
    """Run `roboneuron view` beside that server, within `served_view`; gives the address of its
    page.
    """
    command = [
        sys.executable,
        "-m",
        "roboneuron.cli.main",
        "view",
        "--config",
        str(folder / "roboneuron.toml"),
    ]
    log = folder / "view.log"
    with (
        log.open("w") as errors,
        subprocess.Popen(command, stderr=errors, stdin=subprocess.DEVNULL) as child,
    ):
        try:
            wait_until(lambda: "The view is at http" in log.read_text())
            yield re.findall(r"view is at (http://[\d.]+:\d+)", log.read_text())[0]
        finally:
            child.terminate()
            assert child.wait(60) == 0
