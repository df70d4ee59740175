"""A plugin brings a fifth kind of modules: its section, its tools, its process, without a change in
core.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import anyio
import pytest
from mcp import Client, StdioServerParameters
from mcp.client.stdio import stdio_client

from rn_testing.domain import free_ros_domain
from roboneuron.config import Config, default_text, parse_config
from roboneuron.errors import ConfigurationError, InvalidInputError
from roboneuron.planning import check_configuration
from roboneuron.plugins.discovery import discover
from roboneuron.plugins.registry import Status
from roboneuron.plugins.specs import FeatureSpec
from roboneuron.server.feature import Features

PLUGIN = Path(__file__).parent / "kind_plugin"
SECTION = '\n[finder]\ncamera = "front"\nstart_timeout_s = 50.0\n'


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder with the installed plugin."""
    folder = tmp_path / "site"
    info = folder / "rn_finder-1.0.dist-info"
    info.mkdir(parents=True)
    for module in PLUGIN.glob("*.py"):
        (folder / module.name).write_text(module.read_text())
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: rn-finder\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[roboneuron]\nrn-finder = rn_finder\n")
    monkeypatch.syspath_prepend(str(folder))
    yield folder
    for name in [name for name in sys.modules if name.startswith("rn_finder")]:
        del sys.modules[name]


def config_with(section: str = SECTION) -> Config:
    return parse_config(default_text() + section, registry=discover())


def test_its_section_goes_to_its_process_and_has_what_all_kinds_have(site: Path) -> None:
    config = config_with()
    assert config.modules == {"finder": {"camera": "front", "start_timeout_s": 50.0}}
    assert config.start_timeout_s("finder") == 50.0
    read_again = Config.model_validate_json(config.model_dump_json())
    assert read_again.modules == config.modules
    check_configuration(config, discover())


@pytest.mark.parametrize(
    "section",
    [
        "\n[finder]\n",
        '\n[finder]\ncamera = "front"\nspeed = 1\n',
        '\n[finder]\ncamera = "front"\nstart_timeout_s = -1\n',
        "\n[modules]\nfinder = 1\n",
    ],
    ids=["missing key", "unknown key", "wrong value of a key of every kind", "core's own field"],
)
def test_a_wrong_section_is_refused_when_it_is_read(site: Path, section: str) -> None:
    with pytest.raises(ConfigurationError):
        config_with(section)


def test_its_plan_says_what_it_needs(site: Path) -> None:
    registry = discover()
    kinds = Features(config_with(), registry).kinds
    plan = kinds["finder"].check(config_with(), registry)
    assert (plan.kind, plan.inputs, dict(plan.names)) == (
        "finder",
        ("perception",),
        {"finder": "finder"},
    )


@pytest.mark.parametrize(
    ("was", "becomes"),
    [
        ('name="finder"', 'name="finder-two"'),
        ('    module="rn_finder_module:FinderModule",\n', ""),
        ('    config="rn_finder_options:FinderOptions",\n', ""),
    ],
    ids=["a hyphen", "no class", "no section"],
)
def test_a_kind_that_is_not_whole_is_left_out(site: Path, was: str, becomes: str) -> None:
    plugin = site / "rn_finder.py"
    text = plugin.read_text()
    assert was in text
    plugin.write_text(text.replace(was, becomes))
    registry = discover()
    assert [p.status for p in registry.plugins if p.name == "rn-finder"] == [Status.FAILED]
    assert "finder" not in registry.specs(FeatureSpec)


def test_without_a_section_it_is_offered_and_configured_by_nothing(site: Path) -> None:
    features = Features(config_with(""), discover())
    assert list(features.kinds) == ["finder"]
    with pytest.raises(InvalidInputError):
        features.kinds["finder"].check(config_with(""), discover())


async def operate(server: StdioServerParameters) -> None:
    async def do(client: Client, tool: str, **arguments: Any) -> Any:
        answer = await client.call_tool(tool, arguments)
        assert not answer.is_error, answer.content
        return answer.structured_content

    async def finder(client: Client) -> dict[str, Any]:
        found = (await do(client, "get_status"))["modules"]
        return next(one for one in found if one["module"] == "finder")

    async with Client(stdio_client(server)) as client:
        assert (await client.call_tool("start_finder", {})).is_error, "it has no images"
        await do(client, "start_robot")
        await do(client, "start_perception")
        assert (await do(client, "start_finder"))["health"] == "ok"
        os.kill((await finder(client))["pid"], signal.SIGKILL)
        with anyio.fail_after(10.0):
            while (await finder(client))["phase"] != "exited":
                await anyio.sleep(0.05)
        assert (await do(client, "list_incidents", module="finder"))["incidents"]
        assert (await client.call_tool("list_incidents", {"module": "funder"})).is_error
        await do(client, "get_logs", module="finder")
        await do(client, "start_finder")
        assert (await do(client, "stop_finder"))["module"] == "finder"
        started = await do(client, "start_all")
        assert "finder" in {one["module"] for one in started["started"]}
        stopped = [one["module"] for one in (await do(client, "stop_all"))["stopped"]]
        assert "finder" in stopped


@pytest.mark.ros
@pytest.mark.timeout(240)
def test_it_is_started_watched_and_stopped_by_its_own_tools(site: Path, tmp_path: Path) -> None:
    config = tmp_path / "roboneuron.toml"
    config.write_text(default_text() + SECTION)
    words = ["-m", "roboneuron.cli.main", "serve", "--config", str(config), "--log-level", "error"]
    environment = {
        **os.environ,
        "ROS_DOMAIN_ID": str(free_ros_domain()),
        "XDG_STATE_HOME": str(tmp_path),
        "PYTHONPATH": os.pathsep.join((str(site), os.environ.get("PYTHONPATH", ""))).rstrip(":"),
    }
    server = StdioServerParameters(command=sys.executable, args=words, env=environment)
    anyio.run(operate, server)
