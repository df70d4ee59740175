"""`roboneuron up` and `down`: what they ask of the server, how they find each other, and what is
left.
"""

from __future__ import annotations

import json
import subprocess
import sys
from argparse import Namespace
from collections.abc import Callable, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from mcp.types import TextContent

from rn_standard.console import connection
from rn_standard.console.up_command import Down, Up, keeper
from roboneuron.cli.terminal import show_error
from roboneuron.errors import StateError

pytestmark = pytest.mark.timeout(120)
STARTED = {"ready_after_s": {"control": 1.5, "robot": 2.0}}
STOPPED = {"stopped": [{"module": "control"}, {"module": "robot"}]}
KEEPER = """
import json, sys
from argparse import Namespace
from contextlib import asynccontextmanager
from pathlib import Path
from types import SimpleNamespace

from rn_standard.console import connection
from rn_standard.console.up_command import Up

calls = []

class Server:
    async def list_tools(self):
        return SimpleNamespace(tools=[SimpleNamespace(name="start_all", input_schema={})])

    async def call_tool(self, name, arguments, **_):
        calls.append(name)
        return SimpleNamespace(is_error=False, structured_content={"ready_after_s": {}})

@asynccontextmanager
async def connect(arguments):
    yield Server()

connection.connect = connect
code = Up().run(Namespace(url=None, config=Path(sys.argv[1]), quiet=False, instruction=None, model=None))
print(json.dumps(calls), flush=True)
sys.exit(code)
"""  # noqa: E501


class FakeServer:
    """A client that answers by itself; keeps the calls."""

    def __init__(self) -> None:
        self.names = ["start_all", "stop_all"]
        self.calls: list[tuple[str, dict[str, Any]]] = []
        self.failure = ""
        self.answers: dict[str, Any] = {"start_all": STARTED, "stop_all": STOPPED}

    async def list_tools(self) -> Any:
        return SimpleNamespace(
            tools=[SimpleNamespace(name=name, input_schema={}) for name in self.names]
        )

    async def call_tool(self, name: str, arguments: dict[str, Any], **_: Any) -> Any:
        self.calls.append((name, arguments))
        content = [TextContent(type="text", text=self.failure)]
        return SimpleNamespace(
            is_error=bool(self.failure), content=content, structured_content=self.answers[name]
        )


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> FakeServer:
    made = FakeServer()

    @asynccontextmanager
    async def connect(arguments: Namespace) -> Any:
        yield made

    monkeypatch.setattr(connection, "connect", connect)
    return made


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "roboneuron.toml"
    path.write_text(
        f'[robot]\nname = "gantry"\n[supervisor]\nstate_directory = "{tmp_path}/state"\n'
    )
    return path


@pytest.fixture
def kept(config: Path) -> Iterator[Callable[[], subprocess.Popen[str]]]:
    """Return a function that starts `roboneuron up` in a process, and returns once everything is
    up.
    """
    processes: list[subprocess.Popen[str]] = []

    def start() -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, "-c", KEEPER, str(config)], stdout=subprocess.PIPE, text=True
        )
        processes.append(process)
        assert process.stdout is not None
        assert any("up; Ctrl-C" in line for line in process.stdout)
        return process

    yield start
    for process in processes:
        process.kill()
        process.communicate()


def given(**changes: Any) -> Namespace:
    return Namespace(
        **{
            "url": None,
            "config": None,
            "quiet": False,
            "instruction": None,
            "model": None,
            **changes,
        }
    )


def test_up_of_a_server_starts_what_is_asked_and_leaves_it_running(
    server: FakeServer, capsys: pytest.CaptureFixture[str]
) -> None:
    assert Up().run(given(url="http://robot/mcp", instruction="wave", model="small")) == 0
    assert server.calls == [("start_all", {"instruction": "wave", "model": "small"})]
    assert "robot works after 2.0 s" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("names", "failure", "words"),
    [(["start_all"], "no weights", "no weights"), (["stop_all"], "", "no tool start_all")],
)
def test_up_says_what_failed_and_what_is_missing(
    server: FakeServer,
    capsys: pytest.CaptureFixture[str],
    names: list[str],
    failure: str,
    words: str,
) -> None:
    server.names, server.failure = names, failure
    with pytest.raises(Exception) as caught:  # noqa: PT011 - the command line looks into groups
        Up().run(given(url="http://robot/mcp"))
    assert show_error(caught.value) == 2
    assert words in capsys.readouterr().err


def test_down_of_a_server_stops_everything_there(
    server: FakeServer, capsys: pytest.CaptureFixture[str]
) -> None:
    assert Down().run(given(url="http://robot/mcp")) == 0
    server.answers["stop_all"] = {"stopped": []}
    assert Down().run(given(url="http://robot/mcp")) == 0
    assert capsys.readouterr().out == "stopped control, robot\nnothing ran\n"
    assert server.calls == [("stop_all", {})] * 2


def test_down_ends_what_up_keeps_and_up_stops_the_modules_first(
    config: Path, kept: Callable[[], subprocess.Popen[str]], capsys: pytest.CaptureFixture[str]
) -> None:
    process = kept()
    assert keeper(config.parent / "state" / "up.json") == process.pid
    with pytest.raises(StateError, match="runs already"):
        Up().run(given(config=config))
    assert Down().run(given(config=config)) == 0
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 0
    assert json.loads(output.splitlines()[-1]) == ["start_all", "stop_all"]
    assert not (config.parent / "state" / "up.json").exists()
    assert f"(pid {process.pid})" in capsys.readouterr().out


def test_down_without_up_says_so_also_when_up_was_killed(
    config: Path, kept: Callable[[], subprocess.Popen[str]], capsys: pytest.CaptureFixture[str]
) -> None:
    assert Down().run(given(config=config)) == 1
    process = kept()
    process.kill()
    process.wait(60)
    assert (config.parent / "state" / "up.json").exists()  # it was killed: only the lock tells
    assert Down().run(given(config=config)) == 1
    assert capsys.readouterr().out.count("keeps nothing here") == 2
