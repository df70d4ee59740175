"""Each process gets the link's profile and, on a member, a port of its own; or says why not."""

from __future__ import annotations

import os
import subprocess
import sys
from datetime import UTC, datetime, timedelta
from importlib.resources import files
from pathlib import Path

import pytest

from rn_link.certificates import new_key, read_certificate
from rn_link.environment import OTHERS, check_unopposed, join_link, set_link, take_port
from rn_link.feature import LinkFeature
from rn_link.machine import Machine, Peer, link_folder
from rn_link.options import LinkOptions
from rn_link_pairing.keeping import add_member, become_hub, become_member
from roboneuron import ConfigurationError
from roboneuron.feature import Config

PEER = Peer("10.1.2.3", 7500)
CONFIG = Config.model_construct()
CHANGED = ("FASTRTPS_DEFAULT_PROFILES_FILE", "OPENSSL_CONF", "ROS_AUTOMATIC_DISCOVERY_RANGE")


@pytest.fixture(autouse=True)
def _clean(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    for name in (*CHANGED, *OTHERS, "RMW_IMPLEMENTATION"):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    for name in ("ROBONEURON_LINK", "ROBONEURON_LINK_HOLDER"):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)


@pytest.fixture
def folder() -> Path:
    return link_folder()


def hub(folder: Path, ago_days: int = 0, days: int = 365) -> Machine:
    now = datetime.now(UTC) - timedelta(days=ago_days)
    become_hub(folder, "robot", now, days)
    add_member(folder, "gpu", PEER, new_key().public_key(), now, 365)
    return Machine(name="robot", role="hub", peers={"gpu": PEER})


def member(folder: Path, tmp_path: Path) -> Machine:
    now = datetime.now(UTC)
    become_hub(tmp_path / "far", "robot", now, 365)
    key = new_key()
    certificate = add_member(tmp_path / "far", "gpu", PEER, key.public_key(), now, 365)
    machine = Machine(name="gpu", role="member", port=7500, peers={"robot": PEER})
    become_member(folder, machine, key, certificate, read_certificate(tmp_path / "far/ca.pem"))
    return machine


def test_nothing_changes_without_a_link() -> None:
    before = dict(os.environ)
    join_link()
    assert dict(os.environ) == before


def test_nothing_changes_without_a_peer(folder: Path) -> None:
    become_hub(folder, "robot", datetime.now(UTC), 365)
    before = dict(os.environ)
    join_link()
    assert dict(os.environ) == before


def test_a_process_of_the_hub_gets_profile_and_openssl(folder: Path) -> None:
    hub(folder)
    join_link()
    join_link()
    assert [os.environ[name] for name in CHANGED] == [
        str(folder / "fastdds.xml"),
        str(folder / "openssl.cnf"),
        "SYSTEM_DEFAULT",
    ]
    assert not (folder / "port.lock").exists(), "it connects"


def test_one_process_of_a_member_has_the_port(folder: Path, tmp_path: Path) -> None:
    machine = member(folder, tmp_path)
    own: dict[str, str] = {}
    set_link(own, machine, folder)
    set_link(own, machine, folder)
    assert own["FASTRTPS_DEFAULT_PROFILES_FILE"] == str(folder / "fastdds.xml")
    program = "import os, rn_link.environment as e; e.join_link(); "
    program += f"print([os.environ.get(name) for name in {CHANGED}])"
    # a child inherits the variables of its parent
    made = subprocess.run(
        [sys.executable, "-c", program],
        env={**os.environ, **own},
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    shipped = str(files("roboneuron") / "data" / "fastdds.xml")
    assert made.strip() == str([shipped, None, "LOCALHOST"])


def test_the_port_is_free_again_when_its_process_has_ended(folder: Path, tmp_path: Path) -> None:
    member(folder, tmp_path)
    program = "import rn_link.environment as e; assert e.take_port(e.link_folder())"
    for _ in range(2):
        subprocess.run([sys.executable, "-c", program], check=True)
    assert take_port(folder)
    assert not take_port(folder)


def test_a_process_can_leave_the_link_to_another(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    member(folder, tmp_path)
    monkeypatch.setenv("ROBONEURON_LINK", "off")
    join_link()
    assert not any(name in os.environ for name in CHANGED)
    assert take_port(folder)


@pytest.mark.parametrize("name", [*OTHERS, *CHANGED[:2], "RMW_IMPLEMENTATION"])
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


def test_the_shipped_profile_gives_way(folder: Path) -> None:
    hub(folder)
    os.environ[CHANGED[0]] = str(files("roboneuron") / "data" / "fastdds.xml")
    join_link()
    assert os.environ[CHANGED[0]] == str(folder / "fastdds.xml")


def test_a_damaged_link_is_told_and_not_used(
    folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    hub(folder)
    (folder / "link.json").write_text("{")
    join_link()
    assert "cannot be read" in caplog.text
    assert not any(name in os.environ for name in CHANGED)
    with pytest.raises(ConfigurationError, match="cannot be read"):
        LinkFeature(LinkOptions()).check(CONFIG)


def test_a_server_needs_a_link_only_if_the_configuration_says_so() -> None:
    LinkFeature(LinkOptions()).check(CONFIG)
    with pytest.raises(ConfigurationError, match="No other machine is paired"):
        LinkFeature(LinkOptions(required=True)).check(CONFIG)


def test_a_server_does_not_start_with_an_expired_certificate(folder: Path) -> None:
    hub(folder, ago_days=40, days=30)
    with pytest.raises(ConfigurationError, match="roboneuron link init"):
        LinkFeature(LinkOptions(required=True)).check(CONFIG)


def test_what_expires_soon_is_told(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    hub(folder, ago_days=340, days=365)
    LinkFeature(LinkOptions(required=True, warn_days=10)).check(CONFIG)
    assert not caplog.text
    LinkFeature(LinkOptions(required=True)).check(CONFIG)
    assert "certificate of robot expires" in caplog.text
    assert "certificate of gpu expires" in caplog.text
