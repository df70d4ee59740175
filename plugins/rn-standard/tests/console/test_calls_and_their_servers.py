"""`call` takes tools with and without arguments; -v shows the log of the server that it starts."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import anyio
import pytest

from roboneuron.cli.main import main


def run(state: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-P", "-m", "roboneuron.cli.main", *words],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        env={
            "PATH": "/usr/bin:/bin",
            "XDG_STATE_HOME": str(state),
            "HOME": str(state),
            "ROBONEURON_RECORDER": "off",
        },
        stdin=subprocess.DEVNULL,
    )


@pytest.mark.exhaustive
def test_a_further_tool_needs_no_arguments(tmp_path: Path) -> None:
    done = run(
        tmp_path,
        "call",
        "get_status",
        "--then",
        "list_robots",
        "--then",
        "list_interfaces",
        '{"package": "x"}',
    )
    assert '"robots"' in done.stdout
    assert done.stdout.count("\n}\n") >= 2
    assert "ending" not in done.stderr  # nothing was started: nothing to say
    assert "serves MCP on stdio" not in done.stderr


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("--then", "a", "{}", "c"), "--then takes a tool and its arguments, got 'a {} c'."),
        (
            ("--keep", "--url", "http://127.0.0.1:9/mcp"),
            "--keep is for a server that `call` starts",
        ),
        (("--then", "a", "{"), "is no valid JSON"),
    ],
)
def test_calls_that_make_no_sense_are_refused_before_a_server_starts(
    words: tuple[str, ...],
    reason: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(subprocess, "Popen", lambda *_, **__: pytest.fail("nothing may be started"))
    monkeypatch.setattr(anyio, "open_process", subprocess.Popen)
    assert main(["call", "get_status", *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert reason in line


def test_the_log_of_a_server_of_our_own_is_shown_on_demand(tmp_path: Path) -> None:
    assert "serves MCP on stdio" in run(tmp_path, "call", "get_status", "-vv").stderr
