"""For every paired machine `link show` and `doctor` report whether it is connected, according to
the relay.
"""

from __future__ import annotations

import fcntl
import json
from argparse import ArgumentParser
from pathlib import Path

import pytest
from link_pairs import admit, make_hub

from rn_link.command import LinkCommand
from rn_link.machine import link_folder

PLACE = "The machine {} (10.0.0.9) is {}."


def test_every_machine_is_told_with_its_time_or_its_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    folder = link_folder()
    assert not LinkCommand().findings(), "no link"
    make_hub(folder)
    assert not LinkCommand().findings(), "no peer"
    for name in ("gpu", "desk", "lab"):
        admit(folder, tmp_path / name, name, "10.0.0.9")
    states = {"gpu": {"since": "today"}, "desk": {"error": "no answer", "hint": "Is desk on?"}}
    (folder / "relay.json").write_text(json.dumps(states))
    for lock in ("no file", "of a killed relay"):
        found = LinkCommand().findings()
        assert all("no relay is running" in told for _, told, _ in found), lock
        (folder / "relay.lock").touch()
    with (folder / "relay.lock").open() as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        found = LinkCommand().findings()
        command, parser = LinkCommand(), ArgumentParser()
        command.configure(parser)
        assert command.run(parser.parse_args(["show"])) == 0
    starting = PLACE.format("lab", "NOT connected: it is being connected")
    assert found == [
        (True, PLACE.format("gpu", "connected since today"), ""),
        (False, PLACE.format("desk", "NOT connected: no answer"), "Is desk on?"),
        (False, starting, "Look again in a moment."),
    ]
    shown = capsys.readouterr().out.splitlines()
    assert shown == ["This machine is the hub robot."] + [
        f"{told} {hint}".rstrip() for _, told, hint in found
    ]
