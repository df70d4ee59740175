"""Files of a machine: its own key, exactly its peers' certificates, and a profile."""

from __future__ import annotations

import ssl
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from link_pairs import admit, make_hub

from rn_link.environment import fast_dds_profile
from rn_link.keys import (
    add_peer,
    check_new_peer,
    make_machine,
    new_identity,
    own_certificate,
    remove_all,
    remove_peer,
    to_certificate,
)
from rn_link.machine import (
    Machine,
    Peer,
    check_address,
    check_name,
    read_machine,
)
from rn_link.tls import tls_context
from roboneuron import ConfigurationError

ADDRESS = "10.1.2.3"
NAMESPACE = "http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles"
CERTIFICATE = to_certificate(new_identity())


@pytest.fixture
def hub(tmp_path: Path) -> Path:
    folder = tmp_path / "hub"
    make_hub(folder)
    return folder


@pytest.fixture
def gpu(hub: Path, tmp_path: Path) -> Path:
    """A member of the hub."""
    folder = tmp_path / "gpu"
    admit(hub, folder, "gpu", ADDRESS)
    return folder


def machine_of(folder: Path) -> Machine:
    found = read_machine(folder)
    assert found is not None
    return found


def test_files_are_for_this_user_alone_and_the_key_stays(hub: Path, gpu: Path) -> None:
    for folder in (hub, gpu):
        for path in [folder, *folder.iterdir()]:
            assert not stat.S_IMODE(path.stat().st_mode) & 0o077, path
            is_secret = path.is_file() and "PRIVATE" in path.read_text()
            assert is_secret is (path.name == "own.pem")
    assert (hub / "own.pem").read_text() != (gpu / "own.pem").read_text()
    assert machine_of(hub).peers == {"gpu": Peer(ADDRESS, own_certificate(gpu))}
    assert machine_of(gpu).peers == {"robot": Peer("127.0.0.1", own_certificate(hub))}


@pytest.mark.parametrize("mode", [0o766, 0o740, 0o704, 0o701])
@pytest.mark.parametrize("name", ["own.pem", "."])
def test_a_key_that_others_may_use_is_refused(hub: Path, gpu: Path, name: str, mode: int) -> None:
    assert tls_context(machine_of(hub), hub, "gpu").verify_mode == ssl.CERT_REQUIRED
    (hub / name).chmod(mode)
    with pytest.raises(ConfigurationError, match="others may read or replace"):
        tls_context(machine_of(hub), hub, "gpu")


@pytest.mark.parametrize(
    ("place", "name", "told"),
    [
        ("hub", "robot", "this machine itself"),
        ("hub", "gpu", "paired already"),
        ("hub", "My Lab", "not a name"),
        ("gpu", "lab", "member of the link of robot"),
        ("none", "lab", "no link"),
    ],
)
def test_a_hub_adds_machines_with_names_of_their_own(
    hub: Path, gpu: Path, tmp_path: Path, place: str, name: str, told: str
) -> None:
    before = machine_of(hub)
    for add in (
        lambda: check_new_peer(tmp_path / place, name),
        lambda: add_peer(tmp_path / place, name, Peer(ADDRESS, CERTIFICATE)),
    ):
        with pytest.raises(ConfigurationError, match=told):
            add()
    assert machine_of(hub) == before


def test_a_machine_is_of_one_link(hub: Path, gpu: Path) -> None:
    for folder in (hub, gpu):
        with pytest.raises(ConfigurationError, match="of a link already"):
            make_machine(folder, Machine(name="x", role="hub"), new_identity())
    peers = {"../x": Peer(ADDRESS, CERTIFICATE)}
    with pytest.raises(ConfigurationError, match="not a name"):
        make_machine(hub / "x", Machine(name="x", role="member", peers=peers), new_identity())


def test_removing_leaves_nothing(hub: Path, gpu: Path, tmp_path: Path) -> None:
    admit(hub, tmp_path / "lab", "lab", ADDRESS)
    remove_peer(hub, "gpu")
    assert list(machine_of(hub).peers) == ["lab"]
    with pytest.raises(ConfigurationError, match="Paired: lab"):
        remove_peer(hub, "gpu")
    remove_peer(gpu, "robot")
    remove_all(hub)
    assert not hub.exists()
    assert not gpu.exists()
    with pytest.raises(ConfigurationError, match="no link"):
        remove_all(hub)


@pytest.mark.parametrize(
    "content",
    [
        "",
        "{}",
        "[]",
        '{"name": "a", "role": "boss", "peers": {}}',
        '{"name": "a", "role": "member", "peers": {}}',
        '{"name": "a", "role": "hub", "peers": {"b": ["<", "c"]}}',
        '{"name": "a", "role": "hub", "peers": {"/": ["10.0.0.1", "c"]}}',
        '{"name": "a", "role": "hub", "peers": {"b": ["10.0.0.1"]}}',
        '{"name": "../a", "role": "hub", "peers": {}}',
    ],
)
def test_a_damaged_entry_is_refused(hub: Path, content: str) -> None:
    (hub / "link.json").write_text(content)
    with pytest.raises(ConfigurationError, match="cannot be read"):
        read_machine(hub)


@pytest.mark.parametrize(
    ("check", "values", "told"),
    [
        (check_name, ("", "A", "a b", "-a", "a" * 32, "ä", "../a"), "not a name"),
        (
            check_address,
            ("", "host", "10.0.0", "10.0.0.1</address>", "::1", "10.0.0.256"),
            "not an IPv4 address",
        ),
    ],
)
def test_a_bad_name_or_address_is_refused(
    check: Callable[[str], Any], values: tuple[str, ...], told: str
) -> None:
    for value in values:
        with pytest.raises(ConfigurationError, match=told):
            check(value)


def test_plain_udp_stays_on_loopback() -> None:
    root = ElementTree.fromstring(fast_dds_profile())
    for transport in root.iter(f"{{{NAMESPACE}}}transport_descriptor"):
        kind = transport.findtext(f"{{{NAMESPACE}}}type")
        addresses = [one.text for one in transport.iter(f"{{{NAMESPACE}}}address")]
        assert kind in ("SHM", "UDPv4")
        assert addresses == (["127.0.0.1"] if kind == "UDPv4" else [])
    (peers,) = root.iter(f"{{{NAMESPACE}}}initialPeersList")
    addresses = [one.text for one in peers.iter(f"{{{NAMESPACE}}}address")]
    assert addresses == ["127.90.0.1", "127.0.0.1"]
