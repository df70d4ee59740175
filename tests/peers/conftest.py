"""The server of these tests, and the table of results."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from typing import Any

import psutil
import pytest
from foreign import Server

from rn_interfaces.finder import PREFIXES
from rn_interfaces.learning import learn
from rn_interfaces.sources import definitions
from rn_interfaces.store import DefinitionStore
from rn_testing.agent import blocking_client
from rn_testing.domain import free_ros_domain

OTHERWISE = {
    "msg/Seam.msg": "float64[3] offset\nstring<=16 tool\nuint8[] picture\nint32 added\n",
    "srv/Strike.srv": "Seam seam\n---\nbool success\nstring message\n",
}
"""Definitions of `own_msgs` for this server; the peers lack them."""
CONFIG = """
[robot]
name = "fr3"
[supervisor]
state_directory = "{state}"
"""
EXPOSED = {
    "say": ("publish", "std_msgs/msg/String"),
    "heard": ("read", "std_msgs/msg/String"),
    "measure": ("publish", "std_msgs/msg/UInt8MultiArray"),
    "measured": ("read", "std_msgs/msg/String"),
    "large": ("read", "std_msgs/msg/UInt8MultiArray"),
    "blurred": ("read", "std_msgs/msg/String"),
    "owned": ("publish", "std_msgs/msg/String"),
    "old": ("read", "std_msgs/msg/String"),
    "switch": ("service", "std_srvs/srv/SetBool"),
    "count": ("action", "test_msgs/action/Fibonacci"),
    "seam": ("publish", "own_msgs/msg/Seam"),
    "strike": ("service", "own_msgs/srv/Strike"),
}
COLUMNS = (
    "topic",
    "1 MB",
    "service",
    "action",
    "lifecycle",
    "QoS that does not fit",
    "another definition",
    "recognised as",
)
TABLE = pytest.StashKey[dict[str, dict[str, str]]]()


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A server on loopback, in its own domain."""
    folder = tmp_path_factory.mktemp("server")
    config = folder / "roboneuron.toml"
    text = CONFIG.format(state=folder / "state")
    for name, (kind, of) in EXPOSED.items():
        text += f'[[expose]]\nname = "{name}"\nkind = "{kind}"\ntopic = "{name}"\ntype = "{of}"\n'
        text += "" if kind == "read" else "moves = false\n"
    config.write_text(text)
    domain = free_ros_domain()
    environment = {
        **os.environ,
        "ROS_DOMAIN_ID": str(domain),
        "XDG_DATA_HOME": str(folder / "data"),
        "XDG_CACHE_HOME": str(folder / "cache"),
    }
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(PREFIXES, sys.prefix)
        written = folder / "src" / "own_msgs"
        for name, definition in OTHERWISE.items():
            path = written / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(definition)
        store = DefinitionStore(folder / "data" / "roboneuron" / "interfaces")
        assert not learn(store, definitions(written)).refused
    with blocking_client(config, environment) as (client, portal):

        def call(tool: str, arguments: dict[str, Any]) -> Any:
            return portal.call(client.call_tool, tool, arguments)

        found = next(
            one for one in psutil.Process().children(recursive=True) if "serve" in one.cmdline()
        )
        yield Server(domain, config, environment, call, found)


@pytest.fixture(scope="session")
def table(request: pytest.FixtureRequest) -> dict[str, dict[str, str]]:
    """Observations by peer and column."""
    return request.config.stash.setdefault(TABLE, {})


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    """Print the table."""
    table = config.stash.get(TABLE, {})
    if not table:
        return
    terminalreporter.section("who is on the other end")
    terminalreporter.line(f"| peer | {' | '.join(COLUMNS)} |")
    terminalreporter.line("|---" * (1 + len(COLUMNS)) + "|")
    for peer, row in table.items():
        cells = [row.get(column, "FAILED") for column in COLUMNS]
        terminalreporter.line(f"| {peer} | {' | '.join(cells)} |")
