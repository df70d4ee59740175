"""Files of a machine: its own key, exactly its peers' certificates, and a profile."""

from __future__ import annotations

import ssl
import stat
from pathlib import Path
from xml.etree import ElementTree

import pytest
from link_pairs import admit, make_hub

from rn_link.keys import (
    add_peer,
    check_new_peer,
    make_machine,
    new_identity,
    remove_all,
    remove_peer,
)
from rn_link.machine import (
    Machine,
    Peer,
    check_address,
    check_name,
    check_port,
    read_machine,
)
from rn_link.tls import own_context, tls_context
from roboneuron import ConfigurationError

PEER = Peer("10.1.2.3", 7500)
NAMESPACE = "http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles"


@pytest.fixture
def hub(tmp_path: Path) -> Path:
    folder = tmp_path / "hub"
    make_hub(folder)
    return folder


@pytest.fixture
def gpu(hub: Path, tmp_path: Path) -> Path:
    """A member of the hub."""
    folder = tmp_path / "gpu"
    admit(hub, folder, "gpu", PEER)
    return folder


def machine_of(folder: Path) -> Machine:
    found = read_machine(folder)
    assert found is not None
    return found


def test_files_are_for_this_user_alone_and_the_key_stays(hub: Path, gpu: Path) -> None:
    for folder in (hub, gpu):
        for path in [folder, *folder.rglob("*")]:
            assert not stat.S_IMODE(path.stat().st_mode) & 0o077, path
            assert (b"PRIVATE" in path.read_bytes() if path.is_file() else False) is (
                path.name == "own.key"
            )
    assert (hub / "own.key").read_bytes() != (gpu / "own.key").read_bytes()
    assert (hub / "peers" / "gpu.pem").read_bytes() == (gpu / "own.pem").read_bytes()
    assert machine_of(hub).peers == {"gpu": PEER}


@pytest.mark.parametrize("mode", [0o666, 0o640, 0o604, 0o601])
@pytest.mark.parametrize("name", ["own.key", "."])
def test_a_key_that_others_may_use_is_refused(hub: Path, gpu: Path, name: str, mode: int) -> None:
    (hub / name).chmod(mode | 0o100)
    for context in (
        lambda: own_context(machine_of(hub), hub),
        lambda: tls_context(machine_of(hub), hub, "gpu"),
    ):
        with pytest.raises(PermissionError, match="chmod go= "):
            context()


@pytest.mark.parametrize(
    ("name", "told"),
    [("robot", "this machine itself"), ("gpu", "paired already"), ("My Lab", "not a name")],
)
def test_a_name_is_of_one_machine(hub: Path, gpu: Path, name: str, told: str) -> None:
    before = (hub / "peers" / "gpu.pem").read_bytes()
    with pytest.raises(ConfigurationError, match=told):
        add_peer(hub, name, PEER, new_identity().certificate)
    assert (hub / "peers" / "gpu.pem").read_bytes() == before
    assert list(machine_of(hub).peers) == ["gpu"]


def test_roles_do_not_mix(hub: Path, gpu: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="member of the link of robot"):
        check_new_peer(gpu, "lab")
    with pytest.raises(ConfigurationError, match="no link"):
        check_new_peer(tmp_path / "none", "lab")
    for folder in (hub, gpu):
        with pytest.raises(ConfigurationError, match="of a link already"):
            make_machine(folder, Machine(name="x", role="hub"), new_identity())


def test_removing_leaves_nothing(hub: Path, gpu: Path, tmp_path: Path) -> None:
    admit(hub, tmp_path / "lab", "lab", PEER)
    remove_peer(hub, "gpu")
    assert [path.name for path in (hub / "peers").iterdir()] == ["lab.pem"]
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


@pytest.mark.parametrize(
    ("check", "value", "told"),
    [
        *(
            (check_name, name, "not a name")
            for name in ("", "A", "a b", "-a", "a" * 32, "ä", "../a")
        ),
        *(
            (check_address, address, "not an IPv4 address")
            for address in ("", "host", "10.0.0", "10.0.0.1</address>", "::1", "10.0.0.256")
        ),
        *((check_port, port, f"cannot use port {port}") for port in (-1, 0, 80, 65536)),
    ],
)
def test_a_bad_name_address_or_port_is_refused(check: object, value: object, told: str) -> None:
    assert callable(check)
    with pytest.raises(ConfigurationError, match=told):
        check(value)


def test_plain_udp_stays_on_loopback(gpu: Path) -> None:
    root = ElementTree.fromstring((gpu / "fastdds.xml").read_text())
    for transport in root.iter(f"{{{NAMESPACE}}}transport_descriptor"):
        kind = transport.findtext(f"{{{NAMESPACE}}}type")
        addresses = [one.text for one in transport.iter(f"{{{NAMESPACE}}}address")]
        assert kind in ("SHM", "UDPv4")
        assert addresses == (["127.0.0.1"] if kind == "UDPv4" else [])
    (peers,) = root.iter(f"{{{NAMESPACE}}}initialPeersList")
    addresses = [one.text for one in peers.iter(f"{{{NAMESPACE}}}address")]
    assert addresses == ["127.90.0.1", "127.0.0.1"]


@pytest.mark.parametrize("kind", ["paired", "removed", "again", "another", "issued"])
def test_tls_admits_exactly_a_paired_machine(
    hub: Path, gpu: Path, tmp_path: Path, kind: str
) -> None:
    """All certificates have the same subject: only the key tells machines apart."""
    lab = tmp_path / "lab"
    admit(hub, lab, "lab", PEER)
    shown = gpu
    if kind == "removed":
        remove_peer(hub, "gpu")
        with pytest.raises(FileNotFoundError):
            tls_context(machine_of(hub), hub, "gpu")
        return
    if kind == "again":
        admit(hub, tmp_path / "new", "gpu", PEER)
    if kind == "another":
        shown = lab
    if kind == "issued":
        issue_with_the_key_of(gpu)
    client = tls_context(machine_of(hub), hub, "gpu")
    server = tls_context(machine_of(shown), shown, "robot")
    if kind == "paired":
        shake_hands(client, server)
        return
    with pytest.raises(ssl.SSLCertVerificationError):
        shake_hands(client, server)


def issue_with_the_key_of(folder: Path) -> None:
    """Replace a machine's key and certificate by ones that its earlier key has signed."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    issuer = x509.load_pem_x509_certificate((folder / "own.pem").read_bytes())
    signer = serialization.load_pem_private_key((folder / "own.key").read_bytes(), None)
    identity = new_identity()
    new = x509.load_pem_x509_certificate(identity.certificate)
    made = x509.CertificateBuilder(
        issuer_name=issuer.subject,
        subject_name=x509.Name([]),
        public_key=new.public_key(),
        serial_number=x509.random_serial_number(),
        not_valid_before=issuer.not_valid_before_utc,
        not_valid_after=issuer.not_valid_after_utc,
    )
    assert isinstance(signer, ec.EllipticCurvePrivateKey)
    signed = made.sign(signer, hashes.SHA256())
    (folder / "own.pem").write_bytes(signed.public_bytes(serialization.Encoding.PEM))
    (folder / "own.key").write_bytes(identity.key)


def shake_hands(client: ssl.SSLContext, server: ssl.SSLContext) -> None:
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
