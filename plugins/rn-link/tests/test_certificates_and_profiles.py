"""Files of a machine: its own key, exactly its peers' issuers, and a profile."""

from __future__ import annotations

import json
import ssl
import stat
from datetime import UTC, datetime, timedelta
from pathlib import Path
from xml.etree import ElementTree

import pytest
from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.x509.oid import ExtendedKeyUsageOID

from rn_link.certificates import (
    check_in_time,
    expiries,
    issue,
    new_issuer,
    new_key,
    read_certificate,
    read_key,
)
from rn_link.machine import (
    Machine,
    Peer,
    alias,
    check_address,
    check_name,
    check_port,
    read_machine,
)
from rn_link.profile import NAMESPACE
from rn_link.tls import tls_context, valid_until
from rn_link_pairing.keeping import (
    add_member,
    become_hub,
    become_member,
    read_hub,
    remove_all,
    remove_peer,
)
from roboneuron import ConfigurationError

NOW = datetime.now(UTC)
PEER = Peer("10.1.2.3", 7500)


@pytest.fixture
def hub(tmp_path: Path) -> Path:
    folder = tmp_path / "hub"
    become_hub(folder, "robot", NOW, 365)
    return folder


def add(hub: Path, name: str) -> x509.Certificate:
    return add_member(hub, name, PEER, new_key().public_key(), NOW, 365)


def member(hub: Path, folder: Path, days: int = 365, ago_days: int = 0) -> Machine:
    key = new_key()
    now = NOW - timedelta(days=ago_days)
    certificate = add_member(hub, "gpu", PEER, key.public_key(), now, days)
    machine = Machine(name="gpu", role="member", port=PEER.port, peers={"robot": PEER})
    become_member(folder, machine, key, certificate, read_certificate(hub / "ca.pem"))
    return machine


def trusted(folder: Path, name: str) -> x509.Certificate:
    return read_certificate(folder / "peers" / f"{name}.issuer.pem")


def test_files_are_for_this_user_alone(hub: Path, tmp_path: Path) -> None:
    member(hub, tmp_path / "gpu")
    for folder in (hub, tmp_path / "gpu"):
        for path in [folder, *folder.rglob("*")]:
            assert not stat.S_IMODE(path.stat().st_mode) & 0o077, path


def test_the_hub_trusts_each_member_by_an_issuer_of_its_own(hub: Path) -> None:
    gpu, lab = add(hub, "gpu"), add(hub, "lab")
    gpu.verify_directly_issued_by(trusted(hub, "gpu"))
    lab.verify_directly_issued_by(trusted(hub, "lab"))
    with pytest.raises(ValueError, match="Issuer"):
        gpu.verify_directly_issued_by(trusted(hub, "lab"))


def test_a_removed_member_is_trusted_no_more(hub: Path) -> None:
    add(hub, "gpu")
    add(hub, "lab")
    assert list(remove_peer(hub, "gpu").peers) == ["lab"]
    assert [path.name for path in (hub / "peers").glob("gpu*")] == []
    remove_peer(hub, "lab")
    assert list((hub / "peers").iterdir()) == []


def test_a_member_that_pairs_again_replaces_itself(hub: Path) -> None:
    first, second = add(hub, "gpu"), add(hub, "gpu")
    second.verify_directly_issued_by(trusted(hub, "gpu"))
    with pytest.raises(InvalidSignature):
        first.verify_directly_issued_by(trusted(hub, "gpu"))


def test_two_machines_never_share_an_address_of_the_relay(
    hub: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert alias("gpu") == alias("gpu") != alias("lab")
    add(hub, "gpu")
    monkeypatch.setattr("rn_link_pairing.keeping.alias", lambda name: "127.90.1.1")
    add(hub, "gpu")
    with pytest.raises(ConfigurationError, match="'lab' and 'gpu' lead"):
        add(hub, "lab")


def test_renewing_the_hub_keeps_its_authority_and_members(hub: Path) -> None:
    add(hub, "gpu")
    authority, key = (hub / "ca.pem").read_bytes(), (hub / "own.key").read_bytes()
    machine = become_hub(hub, "another-name", NOW, 30)
    assert (machine.name, list(machine.peers)) == ("robot", ["gpu"])
    assert (hub / "ca.pem").read_bytes() == authority
    assert (hub / "own.key").read_bytes() != key
    assert expiries(machine, hub)["robot"] - NOW < timedelta(days=31)


def test_neither_side_can_take_the_others_part(hub: Path, tmp_path: Path) -> None:
    member(hub, tmp_path / "gpu")
    purposes = [
        read_certificate(folder / "own.pem")
        .extensions.get_extension_for_class(x509.ExtendedKeyUsage)
        .value
        for folder in (hub, tmp_path / "gpu")
    ]
    assert [list(one) for one in purposes] == [
        [ExtendedKeyUsageOID.CLIENT_AUTH],
        [ExtendedKeyUsageOID.SERVER_AUTH],
    ]


def test_an_expired_certificate_says_when_and_what_to_type(hub: Path, tmp_path: Path) -> None:
    machine = member(hub, tmp_path / "gpu", days=30, ago_days=31)
    day = f"{NOW - timedelta(days=1):%Y-%m-%d}"
    with pytest.raises(ConfigurationError, match=f"expired on {day}") as caught:
        check_in_time(machine, tmp_path / "gpu")
    assert "roboneuron link add gpu` on robot" in str(caught.value)
    found = read_hub(hub)
    check_in_time(found, hub)
    with pytest.raises(ConfigurationError, match="roboneuron link init"):
        check_in_time(found, hub, NOW + timedelta(days=366))


@pytest.mark.parametrize("days", [0, -1, 3651])
def test_a_validity_beyond_the_issuers_is_refused(days: int) -> None:
    with pytest.raises(ConfigurationError, match=f"valid for {days} days"):
        issue(new_issuer("a", NOW), "a", "hub", new_key().public_key(), NOW, days)


def test_a_key_that_others_may_read_is_refused(hub: Path) -> None:
    (hub / "own.key").chmod(0o640)
    with pytest.raises(ConfigurationError, match="chmod 600"):
        read_key(hub / "own.key")


@pytest.mark.parametrize("name", ["own.key", "own.pem"])
def test_a_damaged_file_is_named(hub: Path, name: str) -> None:
    (hub / name).write_text("nothing")
    with pytest.raises(ConfigurationError, match=name):
        check_in_time(read_hub(hub), hub)


@pytest.mark.parametrize(
    "content",
    [
        "",
        "{}",
        "[]",
        '{"name": "a", "role": "boss", "port": 7411, "peers": {}}',
        '{"name": "a", "role": "hub", "port": 70000, "peers": {}}',
        '{"name": "a", "role": "hub", "port": 7411, "peers": {"b": ["<", 7411]}}',
        '{"name": "a", "role": "hub", "port": 7411, "peers": {"/": ["::", 7411]}}',
        '{"name": "../a", "role": "hub", "port": 7411, "peers": {}}',
    ],
)
def test_a_damaged_entry_is_refused(hub: Path, content: str) -> None:
    (hub / "link.json").write_text(content)
    with pytest.raises(ConfigurationError, match="cannot be read"):
        read_machine(hub)


def test_an_entry_comes_back_as_it_was(hub: Path) -> None:
    add(hub, "gpu")
    found = read_hub(hub)
    assert found.peers == {"gpu": PEER}
    assert json.loads(found.to_json()) == json.loads((hub / "link.json").read_text())


def test_roles_do_not_mix(hub: Path, tmp_path: Path) -> None:
    member(hub, tmp_path / "gpu")
    with pytest.raises(ConfigurationError, match="member of the link of robot"):
        become_hub(tmp_path / "gpu", "x", NOW, 10)
    with pytest.raises(ConfigurationError, match="no certificate authority"):
        read_hub(tmp_path / "none")
    with pytest.raises(ConfigurationError, match="Paired: gpu"):
        remove_peer(hub, "lab")


def test_removing_leaves_nothing(hub: Path, tmp_path: Path) -> None:
    member(hub, tmp_path / "gpu")
    remove_peer(tmp_path / "gpu", "robot")
    remove_all(hub)
    assert not hub.exists()
    assert not (tmp_path / "gpu").exists()
    with pytest.raises(ConfigurationError, match="no link"):
        remove_all(hub)


@pytest.mark.parametrize("name", ["", "A", "a b", "a/b", "-a", "a" * 32, "ä", "../a"])
def test_a_bad_name_is_refused(name: str) -> None:
    with pytest.raises(ConfigurationError, match="not a name"):
        check_name(name)


@pytest.mark.parametrize(
    "address", ["", "host", "10.0.0", "10.0.0.1</address>", "::1", "10.0.0.256"]
)
def test_a_bad_address_is_refused(address: str) -> None:
    with pytest.raises(ConfigurationError, match="not an IPv4 address"):
        check_address(address)


@pytest.mark.parametrize("port", [-1, 0, 80, 65536])
def test_a_bad_port_is_refused(port: int) -> None:
    with pytest.raises(ConfigurationError, match=f"cannot use port {port}"):
        check_port(port)


def _texts(profile: str, name: str) -> list[str | None]:
    root = ElementTree.fromstring(profile)
    return [one.text for one in root.iter(f"{{{NAMESPACE}}}{name}")]


def test_plain_udp_stays_on_loopback(hub: Path) -> None:
    add(hub, "gpu")
    profile = (hub / "fastdds.xml").read_text()
    root = ElementTree.fromstring(profile)
    for transport in root.iter(f"{{{NAMESPACE}}}transport_descriptor"):
        kind = transport.findtext(f"{{{NAMESPACE}}}type")
        addresses = [one.text for one in transport.iter(f"{{{NAMESPACE}}}address")]
        assert kind in ("SHM", "UDPv4")
        assert addresses == (["127.0.0.1"] if kind == "UDPv4" else [])
    (peers,) = root.iter(f"{{{NAMESPACE}}}initialPeersList")
    addresses = [one.text for one in peers.iter(f"{{{NAMESPACE}}}address")]
    assert addresses == ["127.90.0.1", "127.0.0.1"]


@pytest.mark.parametrize("kind", ["paired", "removed", "again", "another"])
def test_tls_lets_exactly_a_paired_machine_in(hub: Path, tmp_path: Path, kind: str) -> None:
    gpu = tmp_path / "gpu"
    machine = member(hub, gpu)
    add(hub, "lab")
    expected = "lab" if kind == "another" else "gpu"
    if kind == "removed":
        remove_peer(hub, "gpu")
        with pytest.raises(FileNotFoundError):
            tls_context(read_hub(hub), hub, "gpu")
        return
    if kind == "again":
        add(hub, "gpu")
    client = tls_context(read_hub(hub), hub, expected)
    server = tls_context(machine, gpu, "robot")
    if kind == "paired":
        left, right = _handshake(client, server)
        for side in (left, right):
            assert NOW < valid_until(side) < NOW + timedelta(days=366)
        return
    with pytest.raises(ssl.SSLCertVerificationError):
        _handshake(client, server)


def _handshake(client: ssl.SSLContext, server: ssl.SSLContext) -> list[ssl.SSLObject]:
    """Perform a handshake. Raises ssl.SSLError if one side refuses the other."""
    up, down = ssl.MemoryBIO(), ssl.MemoryBIO()
    left = client.wrap_bio(down, up)
    right = server.wrap_bio(up, down, server_side=True)
    for _ in range(4):
        for side in (left, right):
            try:
                side.do_handshake()
            except ssl.SSLWantReadError:
                continue
    # with TLS 1.3 a server refuses only after the client's last message
    assert right.version() == left.version() == "TLSv1.3"
    return [left, right]
