"""Each process gets the link's profile, or reports why not; one of them runs the relay."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from importlib.resources import files
from pathlib import Path

import psutil
import pytest
from link_pairs import admit, make_hub

from rn_link.environment import (
    OTHERS,
    RANGE,
    VARIABLE,
    check_unopposed,
    fast_dds_profile,
    join_link,
    uses_link,
)
from rn_link.feature import LinkFeature
from rn_link.keeper import RelayKeeper
from rn_link.machine import link_folder
from rn_link.state import read_connections
from rn_testing.waiting import wait_until
from roboneuron import ConfigurationError
from roboneuron.feature import Config
from roboneuron.hang_watch import END_SIGNAL

CONFIG = Config.model_construct()


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder of this machine's link, in an environment that names nothing."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    for name in (VARIABLE, RANGE, *OTHERS, "RMW_IMPLEMENTATION", "ROBONEURON_LINK"):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    return link_folder()


@pytest.fixture
def hub(folder: Path, tmp_path: Path) -> Path:
    """Folder of this machine's link, which is paired with another one."""
    make_hub(folder)
    admit(folder, tmp_path / "far", "gpu", "10.1.2.3")
    return folder


@pytest.mark.parametrize("reason", ["no link", "no peer", "switched off", "damaged"])
def test_without_a_link_nothing_changes(
    folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    reason: str,
) -> None:
    if reason != "no link":
        make_hub(folder)
    if reason == "switched off":
        admit(folder, tmp_path / "far", "gpu")
        monkeypatch.setenv("ROBONEURON_LINK", "off")
    if reason == "damaged":
        (folder / "link.json").write_text("{")
        with pytest.raises(ConfigurationError, match="cannot be read"):
            LinkFeature(None).check(CONFIG)
    else:
        LinkFeature(None).check(CONFIG)
    before = dict(os.environ)
    join_link()
    assert dict(os.environ) == before
    assert not uses_link()
    assert ("cannot be read" in caplog.text) is (reason == "damaged")


def test_every_process_of_a_machine_gets_the_profile(hub: Path) -> None:
    """Also where the profile that the project ships is set already; that of an earlier version is
    replaced.
    """
    (hub / "fastdds.xml").write_text("old")
    os.environ[VARIABLE] = str(files("roboneuron") / "data" / "fastdds.xml")
    program = "import os, rn_link.environment as e; e.join_link(); e.join_link(); "
    program += f"print([*map(os.environ.get, {[VARIABLE, RANGE]}), e.uses_link()])"
    made = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    ).stdout
    assert made.strip() == str([str(hub / "fastdds.xml"), "SYSTEM_DEFAULT", True])
    assert (hub / "fastdds.xml").read_text() == fast_dds_profile()


@pytest.mark.parametrize("name", [*OTHERS, VARIABLE, "RMW_IMPLEMENTATION"])
def test_what_contradicts_the_link_is_refused(
    hub: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(name, "mine")
    join_link()
    assert os.environ[name] == "mine"
    for check in (
        lambda: check_unopposed(os.environ, hub),
        lambda: LinkFeature(None).check(CONFIG),
    ):
        with pytest.raises(ConfigurationError, match=f"{name} is 'mine'"):
            check()


def test_a_profile_that_cannot_be_written_is_told(
    hub: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (hub / "fastdds.xml").mkdir()
    join_link()
    assert not uses_link()
    assert "cannot be written" in caplog.text
    with pytest.raises(ConfigurationError, match="cannot be written"):
        LinkFeature(None).check(CONFIG)


@pytest.mark.parametrize("damage", ["exposed", "no key", "no certificate"])
def test_a_server_does_not_start_with_a_key_that_is_not_used(hub: Path, damage: str) -> None:
    if damage == "exposed":
        (hub / "own.pem").chmod(0o644)
    elif damage == "no key":
        (hub / "own.pem").write_text("nothing")
    else:
        facts = json.loads((hub / "link.json").read_text())
        facts["peers"]["gpu"][1] = ""
        (hub / "link.json").write_text(json.dumps(facts))
    with pytest.raises(ConfigurationError, match="The keys for gpu cannot be used"):
        LinkFeature(None).check(CONFIG)


def relays(of: psutil.Process) -> list[psutil.Process]:
    """Running relays started by a process."""
    living = [one for one in of.children() if one.status() != psutil.STATUS_ZOMBIE]
    return [one for one in living if "rn_link.relay" in one.cmdline()]


def is_watched(process: psutil.Process) -> bool:
    """True if it handles the signal that ends a process whose interpreter hangs (proc(5))."""
    status = Path(f"/proc/{process.pid}/status").read_text()
    caught = next(line for line in status.splitlines() if line.startswith("SigCgt"))
    return bool(int(caught.split()[1], 16) >> (END_SIGNAL - 1) & 1)


def test_the_relay_of_another_process_follows_one_that_ends(hub: Path) -> None:
    """A relay of another test may hold the addresses: what counts is which one has the lock."""
    program = "import time; from rn_link.keeper import RelayKeeper; "
    program += "RelayKeeper().start(); time.sleep(60)"
    here, keeper = psutil.Process(), RelayKeeper()
    with subprocess.Popen([sys.executable, "-c", program]) as process:
        try:
            wait_until(lambda: relays(psutil.Process(process.pid)), 20.0, "the first relay")
            (first,) = relays(psutil.Process(process.pid))
            wait_until(lambda: read_connections(hub) is not None, 20.0, "it works")
            wait_until(lambda: is_watched(first), 10.0, "its watch for hangs")
            keeper.start()
            wait_until(lambda: relays(here), 10.0, "the second relay")
        finally:
            process.kill()
    wait_until(lambda: not first.is_running(), 10.0, "the first one ends with its process")
    wait_until(lambda: read_connections(hub) is not None, 10.0, "the second one works")
    (second,) = relays(here)
    second.kill()
    wait_until(lambda: relays(here) not in ([], [second]), 10.0, "a killed one is replaced")
    keeper.close()
    assert relays(here) == []
    assert read_connections(hub) is None
