"""Whatever goes wrong, a command ends with its reason in one line and an exit status for the kind
of error.
"""

from __future__ import annotations

import io
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from roboneuron.cli import terminal
from roboneuron.cli.listing import COMMANDS
from roboneuron.cli.main import main
from roboneuron.errors import ConfigurationError


def run(*words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-P", "-m", "roboneuron.cli.main", *words]
    return subprocess.run(
        command,
        capture_output=True,
        encoding="utf-8",
        timeout=120,
        check=False,
        env={**os.environ, **environment},
        stdin=subprocess.DEVNULL,
    )


def one_line(text: str) -> str:
    lines = text.strip().splitlines()
    assert len(lines) == 1, text
    assert lines[0].startswith("roboneuron: ")
    return lines[0]


class NoServer(BaseHTTPRequestHandler):
    """Answers every request with a page."""

    def do_POST(self) -> None:
        body = b"<html>a page</html>"
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    do_GET = do_DELETE = do_POST

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def page() -> Iterator[str]:
    server = ThreadingHTTPServer(("127.0.0.1", 0), NoServer)
    thread = threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{server.server_address[1]}/mcp"
    server.shutdown()
    server.server_close()
    thread.join(timeout=5)


WRONG = [
    (("call", "get_status", "{"), 2, "is no valid JSON"),
    (("call", "get_status", "--url", "http://127.0.0.1:9/mcp"), 2, "Nobody answers"),
    (("call", "get_status", "--url", "http://127.0.0.1:99999/mcp"), 2, "port must be 0-65535"),
    (("call", "get_status", "--url", "nonsense"), 2, "does not answer as one"),
    (("demo", "--out", "/proc/no-such"), 2, "/proc/no-such: No such file or directory."),
    (("demo", "--config", "/no/such.toml"), 2, "/no/such.toml"),
    (
        ("plugins", "new", "backend", "x", "--out", "/proc/no-such"),
        2,
        "/proc/no-such: No such file or directory.",
    ),
    (("plugins", "new", "backend", "X"), 2, "'X' is malformed"),
    (("estop", "--state", "/proc/no-such"), 2, "cannot be written"),
]


@pytest.mark.parametrize(("words", "status", "reason"), WRONG, ids=[" ".join(w[0]) for w in WRONG])
def test_a_command_that_cannot_be_done_says_why(
    words: tuple[str, ...],
    status: int,
    reason: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    output = ()
    if words[0] == "demo" and "--out" not in words:
        output = ("--out", str(tmp_path / "out"))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    assert main([*words, *output]) == status
    assert reason in one_line(capsys.readouterr().err)


def test_a_process_ends_with_the_line_and_the_status_of_its_command(tmp_path: Path) -> None:
    done = run("estop", "--state", "/proc/no-such", XDG_STATE_HOME=str(tmp_path / "state"))
    assert "cannot be written" in one_line(done.stderr)
    assert done.returncode == 2


def test_a_call_of_a_tool_that_the_server_lacks_says_so(tmp_path: Path) -> None:
    done = run("call", "nonsense", XDG_STATE_HOME=str(tmp_path / "state"))
    assert "no tool 'nonsense'" in one_line(done.stderr)
    assert done.returncode == 1


def test_a_call_shows_why_its_own_server_did_not_start(tmp_path: Path) -> None:
    words = ("call", "get_status", "--config", "/no/such.toml")
    done = run(*words, XDG_STATE_HOME=str(tmp_path / "state"))
    assert "/no/such.toml" in done.stderr  # the server's own line is above
    assert "Traceback" not in done.stderr
    assert done.returncode == 2


def test_a_page_is_no_server(page: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["call", "get_status", "--url", page]) == 2
    assert f"The server at {page} does not answer as one" in one_line(capsys.readouterr().err)


@pytest.mark.ros
@pytest.mark.exhaustive
def test_an_instruction_without_an_object_ends_the_demo_with_one_line(
    tmp_path: Path, free_domain: str
) -> None:
    pytest.importorskip("rn_robot_fr3")
    done = run(
        "demo",
        "--instruction",
        "make me a coffee",
        "--out",
        str(tmp_path),
        PYTHONIOENCODING="ascii",
        XDG_STATE_HOME=str(tmp_path / "state"),
        ROS_DOMAIN_ID=free_domain,
    )
    assert done.returncode == 2
    assert 'The instruction "make me a coffee" names 0 objects of this scene' in one_line(
        done.stderr
    )
    assert "+ start robot" in done.stdout


@pytest.fixture
def free_domain() -> str:
    from rn_testing.domain import free_ros_domain

    return str(free_ros_domain())


@pytest.mark.parametrize(
    ("error", "status", "words"),
    [
        (
            ConfigurationError("It is wrong.", hint="Mend it."),
            2,
            "roboneuron: It is wrong. Mend it.",
        ),
        (
            ExceptionGroup(
                "tasks",
                [ValueError("x"), ExceptionGroup("more", [ConfigurationError("It is wrong.")])],
            ),
            2,
            "roboneuron: It is wrong.",
        ),
        (
            PermissionError(13, "Permission denied", "/closed/x"),
            2,
            "roboneuron: /closed/x: Permission denied.",
        ),
        (
            ExceptionGroup("tasks", [KeyError("x")]),
            70,
            "roboneuron: an unexpected KeyError: 'x'. Set ROBONEURON_TRACE",
        ),
        (BaseExceptionGroup("tasks", [KeyboardInterrupt()]), 130, ""),
        (KeyboardInterrupt(), 130, ""),
    ],
    ids=["deliberate", "nested group", "system", "defect", "interrupted group", "interrupted"],
)
def test_every_exception_becomes_a_status_and_a_line(
    error: BaseException,
    status: int,
    words: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def fail(_: object) -> int:
        raise error

    monkeypatch.delenv(terminal.TRACEBACK_VARIABLE, raising=False)
    monkeypatch.setattr("roboneuron.estop.command.run", fail)
    assert "estop" in COMMANDS
    assert main(["estop"]) == status
    shown = capsys.readouterr().err
    assert shown.startswith(words)
    assert len(shown.splitlines()) == bool(words)


def test_a_defect_is_shown_whole_on_demand(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv(terminal.TRACEBACK_VARIABLE, "1")
    assert terminal.show_error(KeyError("x")) == 70
    assert "KeyError: 'x'" in capsys.readouterr().err.splitlines()[-2]


def test_letters_that_the_terminal_lacks_are_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    raw = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(raw, encoding="ascii"))
    terminal.accept_any_text()
    print("✓ “≥ 3 °” äöü \udc80", flush=True)
    assert raw.getvalue() == b'+ ">= 3 deg" ??? ?\n'


COMMANDS_IN_TURN = """
import sys
from roboneuron.cli.main import main
for line in sys.argv[1:]:
    try:
        status = main(line.split())
    except SystemExit as end:
        status = end.code
    assert status in (0, 2), line
"""


@pytest.mark.parametrize(
    "setting",
    [
        {"PYTHONIOENCODING": "ascii"},
        pytest.param(
            {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"},
            marks=pytest.mark.exhaustive,
        ),
    ],
)
def test_commands_run_on_an_ascii_terminal(setting: dict[str, str], tmp_path: Path) -> None:
    commands = ("plugins list", "plugins show servo", "config reference", "tools", "--help")
    done = subprocess.run(
        [sys.executable, "-P", "-c", COMMANDS_IN_TURN, *commands],
        capture_output=True,
        encoding="utf-8",
        timeout=120,
        check=False,
        env={**os.environ, **setting, "XDG_STATE_HOME": str(tmp_path)},
        stdin=subprocess.DEVNULL,
    )
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert done.stdout.isascii()
