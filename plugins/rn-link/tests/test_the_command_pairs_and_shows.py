"""`roboneuron link`, as typed by a person."""

from __future__ import annotations

import asyncio
import io
import re
import threading
from argparse import ArgumentParser
from pathlib import Path

import pytest
from link_members import Net
from link_members import net as net

from rn_link import pairing
from rn_link.command import LinkCommand, check_code, host_name
from rn_link.pairing import join
from rn_testing.waiting import wait_until
from roboneuron import ConfigurationError


@pytest.fixture(autouse=True)
def _state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))


def link(*arguments: str) -> None:
    command, parser = LinkCommand(), ArgumentParser()
    command.configure(parser)
    assert command.run(parser.parse_args(arguments)) == 0


def test_two_machines_are_paired_shown_and_parted(
    tmp_path: Path, net: Net, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Both sides by commands: `test_the_ten_commands_move_an_arm` of rn-backend-openpi."""
    monkeypatch.setattr(pairing.open_listener, "__defaults__", (net.port,))
    link("init", "--name", "robot")
    adding = threading.Thread(target=link, args=("add", "gpu"))
    adding.start()
    told = ""

    def shown() -> re.Match[str] | None:
        nonlocal told
        told += capsys.readouterr().out
        return re.search(r"Code: (\d{3} \d{3})\n", told)

    wait_until(shown, 30.0, "the code")
    found = shown()
    assert found is not None
    member = tmp_path / "member"
    asyncio.run(join(member, "127.0.0.1", check_code(found[1]), net.port))
    adding.join(10.0)
    told += capsys.readouterr().out
    assert "This machine is the hub robot" in told
    assert "gpu is added: 127.0.0.1" in told
    link("show")
    assert "The machine gpu (127.0.0.1) is NOT connected" in capsys.readouterr().out
    with pytest.raises(ConfigurationError, match="paired already"):
        link("add", "gpu")
    link("remove", "gpu")
    link("show")
    assert "The machine gpu" not in capsys.readouterr().out
    link("remove", "--all")
    with pytest.raises(ConfigurationError, match="no link"):
        link("show")


@pytest.mark.parametrize(
    ("arguments", "text", "told"),
    [
        (["add", "gpu"], "", "no link"),
        (["run"], "", "no link"),
        (["remove", "gpu"], "", "No machine 'gpu' is paired"),
        (["init", "--join", "robot.local"], "1", "not an IPv4 address"),
        (["init", "--join", "10.0.0.1"], "12\n", "not six digits"),
        (["init", "--name", "My Robot"], "", "not a name"),
    ],
)
def test_a_wrong_input_gets_one_sentence(
    monkeypatch: pytest.MonkeyPatch, arguments: list[str], text: str, told: str
) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO(text))
    with pytest.raises(ConfigurationError, match=told):
        link(*arguments)


def test_a_code_may_have_spaces_and_nothing_else() -> None:
    assert check_code(" 123 456\n") == "123456"
    for text in ("", "12345", "1234567", "12345a", "١٢٣٤٥٦"):
        with pytest.raises(ConfigurationError, match="six digits"):
            check_code(text)


def test_a_host_name_is_put_into_form(monkeypatch: pytest.MonkeyPatch) -> None:
    for found, expected in {"Lab_PC.local": "lab-pc-local", "...": "robot"}.items():
        monkeypatch.setattr("socket.gethostname", lambda found=found: found)
        assert host_name() == expected
