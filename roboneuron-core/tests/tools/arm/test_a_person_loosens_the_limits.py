"""Tightened limits hold at once and after a restart of the server; a person loosens them, in a
terminal or asked.
"""

from __future__ import annotations

import json
import sys
from argparse import ArgumentParser
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import anyio
import pytest

from rn_testing.waiting import wait_until
from roboneuron.direct_path.plugin import FEATURE as DIRECT_PATH
from roboneuron.errors import ConfigurationError, InvalidInputError, RefusedError
from roboneuron.server.app import Application
from roboneuron.tools.arm.limits_command import Limits
from roboneuron.tools.arm.limits_feature import LimitsFeature
from roboneuron.tools.arm.plugin import LIMITS
from roboneuron.tools.arm.tightening import FILE_NAME

CONFIG = (
    '[robot]\nname = "gantry"\n[control]\ncontroller = "gantry"\n[limits]\nmax_speed_m_s = 0.4\n'
)
Make = Callable[[], Application]


@pytest.fixture
def make(application_of: Callable[..., Application]) -> Make:
    """Return a function that builds a server on one state directory."""
    return lambda: application_of(DIRECT_PATH, LIMITS, text=CONFIG)


def call(
    application: Application, tool: str, agrees: str | None = None, **arguments: Any
) -> dict[str, Any]:
    found = application.tools.get(tool)
    assert found is not None

    async def run(work: Callable[[Any], Any], **more: Any) -> Any:
        return work(lambda _: None)

    async def ask(question: str) -> str | None:
        assert "0.1" in question, "the person is told what would be loosened"
        return agrees

    context: Any = SimpleNamespace(run=run, ask=ask, who="agent-1", role="admin", simulated=False)
    return dict(anyio.run(found.call, arguments, context).structured)


def test_what_is_tightened_holds_for_what_starts_later_and_after_the_server_starts_again(
    make: Make,
) -> None:
    first = make()
    assert call(first, "tighten_limits", max_speed_m_s=0.1)["max_speed_m_s"] == 0.1
    assert call(first, "tighten_limits", max_speed_m_s=0.3)["max_speed_m_s"] == 0.1
    assert first.supervisor.tightened is not None
    assert first.host.loop.limits.max_speed_m_s == 0.1
    second = make()
    assert second.supervisor.tightened == first.supervisor.tightened
    status: Any = second.tools.get("get_status")
    caller = SimpleNamespace(who="agent-1", role="admin")
    told = anyio.run(status.call, {}, caller).structured["tightened_limits"]
    assert told["max_speed_m_s"] == 0.1


def test_the_gate_of_the_direct_path_judges_by_the_tightened_limits(make: Make) -> None:
    application = make()
    paths: Any = application.host.features.loaded.get("direct-path").allow_list._paths  # type: ignore[union-attr]
    assert paths._limits("gantry").max_speed_m_s == 0.4
    call(application, "tighten_limits", max_speed_m_s=0.1)
    assert paths._limits("gantry").max_speed_m_s == 0.1
    assert paths._limits("another").max_speed_m_s == 0.5, "that of another robot stays"


@pytest.mark.parametrize("agrees", [None, ""])
def test_nobody_but_a_person_loosens(make: Make, agrees: str | None) -> None:
    application = make()
    call(application, "tighten_limits", max_speed_m_s=0.1)
    with pytest.raises(RefusedError, match="Only a person") as caught:
        call(application, "loosen_limits", agrees)
    assert "roboneuron robot limits --loosen" in caught.value.hint
    assert application.host.loop.limits.max_speed_m_s == 0.1


def test_a_person_who_agrees_gets_the_configured_limits_back_and_the_audit_says_so(
    make: Make, tmp_path: Path
) -> None:
    application = make()
    call(application, "tighten_limits", max_speed_m_s=0.1)
    assert call(application, "loosen_limits", "yes")["max_speed_m_s"] == 0.4
    assert make().supervisor.tightened is None
    lines = [
        json.loads(line) for line in (tmp_path / "state" / "audit.jsonl").read_text().splitlines()
    ]
    assert [(line["tool"], line["verdict"], line["who"]) for line in lines] == [
        ("tighten_limits", "tightened", "agent-1"),
        ("loosen_limits", "loosened", "a person asked by agent-1"),
    ]


def test_a_call_that_tightens_nothing_or_leaves_nothing_is_refused(make: Make) -> None:
    application = make()
    with pytest.raises(InvalidInputError, match="tightens nothing"):
        call(application, "tighten_limits")
    with pytest.raises(InvalidInputError, match="leave nothing"):
        call(application, "tighten_limits", x_min_m=0.5, x_max_m=0.4)
    assert application.supervisor.tightened is None


def test_a_file_that_vanishes_is_written_again(make: Make, tmp_path: Path) -> None:
    application = make()
    call(application, "tighten_limits", max_speed_m_s=0.1)
    (tmp_path / "state" / FILE_NAME).unlink()
    feature = application.host.feature(LIMITS.name, LimitsFeature)
    feature._look()
    assert (tmp_path / "state" / FILE_NAME).exists()
    assert application.supervisor.tightened is not None


def test_a_server_does_not_start_with_a_damaged_file(make: Make, tmp_path: Path) -> None:
    (tmp_path / "state").mkdir()
    (tmp_path / "state" / FILE_NAME).write_text("{")
    with pytest.raises(ConfigurationError, match="cannot be read"):
        make()


@pytest.mark.parametrize(("answer", "status"), [("y", 0), ("n", 1)])
def test_a_person_in_a_terminal_is_asked_and_a_running_server_notices(
    make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, answer: str, status: int
) -> None:
    application = make()
    call(application, "tighten_limits", max_speed_m_s=0.1)
    application.features.start(application.host)
    told: list[tuple[str, str]] = []
    application.events.uncalled.listen(lambda tool, who, facts: told.append((tool, who)))
    monkeypatch.setattr(sys.stdin, "isatty", lambda: True, raising=False)
    monkeypatch.setattr("builtins.input", lambda prompt: answer)
    assert command(tmp_path, "--loosen") == status
    if status == 0:
        wait_until(lambda: bool(told), 10.0)
    assert (application.supervisor.tightened is None) == (status == 0)
    assert [tool for tool, _ in told] == ["loosen_limits"] * (status == 0)


def test_without_a_terminal_nothing_is_loosened(
    make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command(tmp_path) == 0
    assert "No limits are tightened" in capsys.readouterr().out
    call(make(), "tighten_limits", max_speed_m_s=0.1)
    assert command(tmp_path) == 0
    assert '{"max_speed_m_s": 0.1}, by agent-1' in capsys.readouterr().out
    monkeypatch.setattr(sys.stdin, "isatty", lambda: False, raising=False)
    with pytest.raises(RefusedError, match="a person in a terminal"):
        command(tmp_path, "--loosen")


def command(tmp_path: Path, *arguments: str) -> int:
    parser, limits = ArgumentParser(), Limits()
    limits.configure(parser)
    return limits.run(parser.parse_args(["--state", str(tmp_path / "state"), *arguments]))
