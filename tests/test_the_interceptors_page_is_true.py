"""docs/interceptors.md lists the chain as it is, and old hooks point to it."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from roboneuron.config import parse_config
from roboneuron.config.reading import default_text
from roboneuron.errors import PluginError
from roboneuron.plugins.discovery import discover
from roboneuron.server.app import Application
from roboneuron.server.host import Events
from roboneuron.server.interception import CallPhase
from roboneuron.server.loop import ClosedLoop
from roboneuron.server.registry import ToolRegistry

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "interceptors.md").read_text(encoding="utf-8")
ROW = re.compile(r"^\| ([A-Z]+) \| `([^`]+)` \| (\S+) \|", re.MULTILINE)


def test_the_page_lists_the_chain_of_a_server_with_all_features(tmp_path: Path) -> None:
    text = f"{default_text()}\n[view]\nenabled = true\n[tasks]\napproval = ['run_task']\n"
    application = Application(parse_config(text, registry=discover()), directory=tmp_path)
    try:
        chain = [(step.phase.name, step.name) for step in application.tools.chain.steps]
        features = {*application.features.loaded}
    finally:
        application.close()
    rows = ROW.findall(PAGE)
    assert [(phase, name) for phase, name, _ in rows] == chain
    assert {of for *_, of in rows} - {"core"} <= features


def test_every_phase_is_on_the_page() -> None:
    assert {phase for phase, *_ in ROW.findall(PAGE)} == {phase.name for phase in CallPhase}


def test_no_feature_stands_between_a_client_and_a_tool_by_other_means() -> None:
    """Middleware of the MCP server is for its protocol: MCP Tasks and the end of HTTP requests."""
    found = {
        path.relative_to(ROOT).as_posix()
        for path in ROOT.glob("plugins/*/src/**/*.py")
        if re.search(r"\bserver\.middleware\b", path.read_text(encoding="utf-8"))
    }
    standard = "plugins/rn-standard/src/rn_standard"
    assert found == {f"{standard}/http/server.py", f"{standard}/tasks/feature.py"}


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        (ToolRegistry, "admissions"),
        (ToolRegistry, "replace"),
        (ClosedLoop, "choose"),
        (Events, "call"),
    ],
)
def test_an_older_hook_points_to_the_page(kind: type, name: str) -> None:
    used: Any = object.__new__(kind)
    with pytest.raises(PluginError) as read:
        getattr(used, name)
    with pytest.raises(PluginError):
        setattr(used, name, SimpleNamespace())
    assert "docs/interceptors.md" in read.value.hint
    assert f"{kind.__name__}.{name}" in read.value.message
