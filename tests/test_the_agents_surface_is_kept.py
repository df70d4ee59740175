"""Features became plugins without a change for agents: the same tools with the same arguments.

`data/tools-list-before.json` is the default server's `tools/list` before core was split,
`...-after.json` after it. They differ in output schemas (smaller; docs/tools.md explains the
fields), texts, and choices of installed things. `data/tools-list-additions.json` contains
deliberate additions since: arguments by tool, all optional for recorded tools.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from roboneuron.config.reading import default_text

DATA = Path(__file__).parent / "data"
RENAMED = {"dry_run": "simulate"}
Listing = dict[str, dict[str, Any]]


def by_name(tools: list[dict[str, Any]]) -> Listing:
    return {tool["name"]: tool for tool in tools}


def arguments(tool: dict[str, Any]) -> dict[str, Any]:
    """The part of a tool that callers rely on: names, types, and required arguments."""
    schema = tool["inputSchema"]
    types = {name: entry.get("type", "any") for name, entry in schema.get("properties", {}).items()}
    return {
        "types": types,
        "required": sorted(schema.get("required", [])),
        "open": schema.get("additionalProperties"),
    }


@pytest.fixture(scope="module")
def now(tmp_path_factory: pytest.TempPathFactory) -> Listing:
    """The default server's tools."""
    config = tmp_path_factory.mktemp("standard") / "roboneuron.toml"
    config.write_text(default_text())
    done = subprocess.run(
        [sys.executable, "-m", "roboneuron.cli.main", "tools", "--json", "--config", str(config)],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    return by_name(json.loads(done.stdout))


@pytest.mark.parametrize("record", ["before", "after"])
def test_the_tools_and_their_arguments_are_those_of_the_record(now: Listing, record: str) -> None:
    recorded = by_name(json.loads((DATA / f"tools-list-{record}.json").read_text(encoding="utf-8")))
    added: dict[str, dict[str, str]] = json.loads(
        (DATA / "tools-list-additions.json").read_text(encoding="utf-8")
    )
    assert now.keys() == recorded.keys() | added.keys()
    for name, tool in recorded.items():
        expected = arguments(tool)
        # `dry_run` is called `simulate` since, and both are accepted
        types = {RENAMED.get(key, key): kind for key, kind in expected["types"].items()}
        given = arguments(now[name])
        assert given | {"required": []} == expected | {
            "types": types | added.get(name, {}),
            "required": [],
        }, name
        assert set(given["required"]) <= set(expected["required"]), (
            f"{name} demands more than it did"
        )
    for name in added.keys() - recorded.keys():
        assert arguments(now[name])["types"] == added[name], name


def test_what_a_tool_does_to_the_robot_is_told_as_before(now: Listing) -> None:
    recorded = by_name(json.loads((DATA / "tools-list-before.json").read_text(encoding="utf-8")))
    for name, tool in recorded.items():
        hints, told = tool["annotations"], now[name]["annotations"]
        assert told["readOnlyHint"] == hints["readOnlyHint"], name
        if not hints["readOnlyHint"]:
            assert told["destructiveHint"] == hints["destructiveHint"], name
