"""Each process gets the link's profile, or reports why not; one of them runs the relay."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib.resources import files
from pathlib import Path

import psutil
import pytest
from link_pairs import admit, make_hub

from rn_link.environment import OTHERS, check_unopposed, join_link, uses_link
from rn_link.feature import LinkFeature, LinkOptions
from rn_link.keeper import RelayKeeper
from rn_link.machine import Peer, link_folder
from rn_testing.waiting import wait_until
from roboneuron import ConfigurationError
from roboneuron.feature import Config
from roboneuron.hang_watch import END_SIGNAL

PEER = Peer("10.1.2.3", 7500)
CONFIG = Config.model_construct()
CHANGED = ("FASTRTPS_DEFAULT_PROFILES_FILE", "ROS_AUTOMATIC_DISCOVERY_RANGE")


@pytest.fixture(autouse=True)
def _clean(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    for name in (*CHANGED, *OTHERS, "RMW_IMPLEMENTATION"):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    monkeypatch.setenv("ROBONEURON_LINK", "")
    monkeypatch.delenv("ROBONEURON_LINK")


@pytest.fixture
def folder() -> Path:
    return link_folder()


def hub(folder: Path) -> None:
    make_hub(folder)
    admit(folder, folder.with_name("far"), "gpu", PEER)


@pytest.mark.parametrize("reason", ["no link", "no peer", "switched off", "damaged"])
def test_without_a_link_nothing_changes(
    folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, reason: str
) -> None:
    if reason != "no link":
        make_hub(folder)
    if reason in ("switched off", "damaged"):
        admit(folder, folder.with_name("far"), "gpu", PEER)
    if reason == "switched off":
        monkeypatch.setenv("ROBONEURON_LINK", "off")
    if reason == "damaged":
        (folder / "link.json").write_text("{")
        with pytest.raises(ConfigurationError, match="cannot be read"):
            LinkFeature(LinkOptions()).check(CONFIG)
    before = dict(os.environ)
    join_link()
    assert dict(os.environ) == before
    assert not uses_link()
    assert ("cannot be read" in caplog.text) is (reason == "damaged")


@pytest.mark.parametrize("role", ["hub", "member"])
def test_every_process_of_a_machine_gets_the_profile(
    folder: Path, tmp_path: Path, role: str
) -> None:
    """Also where the profile that the project ships is set already."""
    if role == "hub":
        hub(folder)
    else:
        make_hub(tmp_path / "far")
        admit(tmp_path / "far", folder, "gpu", PEER)
    os.environ[CHANGED[0]] = str(files("roboneuron") / "data" / "fastdds.xml")
    program = "import os, rn_link.environment as e; e.join_link(); e.join_link(); "
    program += f"print([*map(os.environ.get, {CHANGED}), e.uses_link()])"
    made = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    ).stdout
    assert made.strip() == str([str(folder / "fastdds.xml"), "SYSTEM_DEFAULT", True])


def relays() -> list[psutil.Process]:
    """Running relays started by this process."""
    found = psutil.Process().children()
    living = [one for one in found if one.status() != psutil.STATUS_ZOMBIE]
    return [one for one in living if "rn_link.relay" in one.cmdline()]


def is_watched(process: psutil.Process) -> bool:
    """True if it handles the signal that ends a process whose interpreter hangs (proc(5))."""
    status = Path(f"/proc/{process.pid}/status").read_text()
    caught = next(line for line in status.splitlines() if line.startswith("SigCgt"))
    return bool(int(caught.split()[1], 16) >> (END_SIGNAL - 1) & 1)


def test_one_of_several_processes_keeps_the_relay_and_another_follows(folder: Path) -> None:
    hub(folder)
    keepers = [RelayKeeper(folder) for _ in range(3)]
    try:
        keepers[0].start()
        wait_until(lambda: len(relays()) == 1, 10.0, "the first relay")
        (first,) = relays()
        wait_until(lambda: is_watched(first), 10.0, "its watch for hangs")
        for keeper in keepers[1:]:
            keeper.start()
        keepers[0].close()
        assert not first.is_running()
        wait_until(lambda: len(relays()) == 1, 10.0, "the second relay")
        (second,) = relays()
        second.kill()
        wait_until(lambda: relays() not in ([], [second]), 10.0, "the third relay")
        assert len(relays()) == 1
    finally:
        for keeper in keepers:
            keeper.close()
    assert relays() == []


def test_a_relay_ends_with_its_process(folder: Path) -> None:
    hub(folder)
    program = "import time; from pathlib import Path; from rn_link.keeper import RelayKeeper; "
    program += f"RelayKeeper(Path({str(folder)!r})).start(); time.sleep(60)"
    with subprocess.Popen([sys.executable, "-c", program]) as process:
        parent = psutil.Process(process.pid)
        wait_until(lambda: parent.children(), 20.0, "the relay")
        (relay,) = parent.children()
        process.kill()
    wait_until(lambda: not relay.is_running(), 10.0, "the end of the relay")


@pytest.mark.parametrize("name", [*OTHERS, CHANGED[0], "RMW_IMPLEMENTATION"])
def test_what_contradicts_the_link_is_refused(
    folder: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    hub(folder)
    monkeypatch.setenv(name, "mine")
    join_link()
    assert os.environ[name] == "mine"
    with pytest.raises(ConfigurationError, match=f"{name} is 'mine'"):
        check_unopposed(os.environ, folder)
    with pytest.raises(ConfigurationError, match=name):
        LinkFeature(LinkOptions()).check(CONFIG)


def test_a_server_needs_a_link_only_if_the_configuration_says_so() -> None:
    LinkFeature(LinkOptions()).check(CONFIG)
    with pytest.raises(ConfigurationError, match="No other machine is paired"):
        LinkFeature(LinkOptions(required=True)).check(CONFIG)


@pytest.mark.parametrize("damage", ["exposed", "no key", "no certificate"])
def test_a_server_does_not_start_with_a_key_that_is_not_used(folder: Path, damage: str) -> None:
    hub(folder)
    if damage == "exposed":
        (folder / "own.key").chmod(0o644)
    else:
        (folder / ("own.key" if damage == "no key" else "own.pem")).write_text("nothing")
    with pytest.raises(ConfigurationError, match="is not used"):
        LinkFeature(LinkOptions()).check(CONFIG)
