"""What is installed is listed as a choice, also what was installed while the server runs."""

from __future__ import annotations

from typing import Any

import anyio
import pytest
from mcp import Client, types

from rn_testing.fakes import fake_registry
from roboneuron.config import Config
from roboneuron.plugins.registry import Registry
from roboneuron.plugins.specs import BackendSpec
from roboneuron.selection.plugin import FEATURE
from roboneuron.server.app import Application


def listing(application: Application) -> dict[str, types.Tool]:
    async def ask() -> dict[str, types.Tool]:
        async with Client(application.server) as client:
            return {tool.name: tool for tool in (await client.list_tools()).tools}

    return anyio.run(ask)


def test_choices_are_the_installed_plugins_and_a_list_tells_of_them(
    application: Application,
) -> None:
    tools = listing(application)
    backend = tools["start_inference"].input_schema["properties"]["backend"]
    assert sorted(backend["enum"]) == ["heavy", "instant"]
    assert backend["description"] == "Which policy; see list_backends."
    assert tools["start_inference"].input_schema["properties"]["runtime"]["enum"] == ["counting"]


def test_a_newly_installed_plugin_appears_as_a_choice(
    tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    site = tmp_path / "site-packages"
    site.mkdir()
    monkeypatch.syspath_prepend(str(site))
    installed: list[BackendSpec] = []

    def discover() -> Registry:
        return fake_registry(FEATURE, *installed)

    config = Config.model_validate({"robot": {"name": "gantry"}})
    application = Application(config, plugins=discover)
    assert (
        "fresh"
        not in listing(application)["start_inference"].input_schema["properties"]["backend"]["enum"]
    )
    installed.append(BackendSpec(name="fresh", summary="Just installed.", target="fresh:Fresh"))
    (site / "fresh-1.0.dist-info").mkdir()
    assert (
        "fresh"
        in listing(application)["start_inference"].input_schema["properties"]["backend"]["enum"]
    )
    application.close()


def test_without_plugins_there_are_no_empty_enums() -> None:
    empty = Registry(plugins=(), all_offers=fake_registry(FEATURE).offers("feature"))
    application = Application(
        Config.model_validate({"robot": {"name": "gantry"}}),
        plugins=lambda: empty,
    )
    tools = {tool.name: tool.input_schema["properties"] for tool in application.tools.listing()}
    assert (
        "Nothing is installed to choose from." in tools["start_inference"]["backend"]["description"]
    )
    assert all(
        "enum" not in entry or entry["enum"]
        for entries in tools.values()
        for entry in entries.values()
    )
    application.close()
