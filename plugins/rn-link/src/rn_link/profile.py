"""The Fast DDS profile and the OpenSSL configuration of a machine of the link.

Source: Fast DDS 2.14 XML profiles (TCPv4 transport with `tls`); OpenSSL 1.1.1 config(5) and
SSL_CONF_cmd(3).
"""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from xml.etree import ElementTree

from rn_link.machine import Machine

NAMESPACE = "http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles"
LOOPBACK = "127.0.0.1"
SEND_BUFFER_BYTES = 2_097_152
"""Of each connection at most; twice this may wait to be sent, then messages are dropped."""
LIMIT = Path("/proc/sys/net/core/wmem_max")
_TCP = "roboneuron_link"
OPENSSL = """\
# Fast DDS 2.14 takes no verify_mode for the side that listens: without this a peer without a
# certificate would get in.
openssl_conf = roboneuron_link
[roboneuron_link]
ssl_conf = roboneuron_tls
[roboneuron_tls]
system_default = roboneuron_peers
[roboneuron_peers]
VerifyMode = Peer,Request,Require
MinProtocol = TLSv1.2
"""
"""Every TLS context of a process that leaves verification to its defaults then asks for a
certificate.
"""


def fast_dds_profile(machine: Machine, folder: Path) -> str:
    """Return the shipped profile with UDP held to the loopback interface, and TLS to the peers.

    Processes of one machine find each other by UDP on the loopback interface, as without a link.

    Args:
        folder: with the certificates and the key.
    """
    ElementTree.register_namespace("", NAMESPACE)
    shipped = files("roboneuron").joinpath("data/fastdds.xml").read_text(encoding="utf-8")
    root = ElementTree.fromstring(shipped)
    transports = _child(root, "transport_descriptors")
    for transport in transports:
        if _child(transport, "type").text == "UDPv4":
            _add(_add(transport, "interfaceWhiteList"), "address", LOOPBACK)
    transports.append(_transport(machine, folder))
    rtps = _child(_child(root, "participant"), "rtps")
    _add(_child(rtps, "userTransports"), "transport_id", _TCP)
    _child(rtps, "builtin").append(_initial_peers(machine))
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def send_buffer_bytes() -> int:
    """Half of what the kernel of this machine allows a process to ask for; see `connections`."""
    return min(SEND_BUFFER_BYTES, int(LIMIT.read_text(encoding="ascii")) // 2)


def _transport(machine: Machine, folder: Path) -> ElementTree.Element:
    transport = ElementTree.Element(_tag("transport_descriptor"))
    _add(transport, "transport_id", _TCP)
    _add(transport, "type", "TCPv4")
    _add(transport, "sendBufferSize", str(send_buffer_bytes()))
    # see `connections`
    _add(transport, "non_blocking_send", "true")
    listens = machine.role == "member"
    if listens:
        _add(_add(transport, "listening_ports"), "port", str(machine.port))
    # TLS protects each byte already
    _add(transport, "calculate_crc", "false")
    _add(transport, "check_crc", "false")
    tls = _add(transport, "tls")
    _add(tls, "cert_chain_file", str(folder / "own.pem"))
    _add(tls, "private_key_file", str(folder / "own.key"))
    _add(tls, "verify_file", str(folder / "trusted.pem"))
    if not listens:
        _add(_add(tls, "verify_mode"), "verify", "VERIFY_PEER")
    _add(tls, "handshake_role", "SERVER" if listens else "CLIENT")
    return transport


def _initial_peers(machine: Machine) -> ElementTree.Element:
    peers = ElementTree.Element(_tag("initialPeersList"))
    if machine.role == "hub":
        for peer in machine.peers.values():
            place = _add(_add(peers, "locator"), "tcpv4")
            _add(place, "address", peer.address)
            _add(place, "physical_port", str(peer.port))
    _add(_add(_add(peers, "locator"), "udpv4"), "address", LOOPBACK)
    return peers


def _tag(name: str) -> str:
    return f"{{{NAMESPACE}}}{name}"


def _child(parent: ElementTree.Element, name: str) -> ElementTree.Element:
    found = parent.find(_tag(name))
    if found is None:
        raise LookupError(f"the shipped profile has no {name} in {parent.tag}")
    return found


def _add(parent: ElementTree.Element, name: str, text: str | None = None) -> ElementTree.Element:
    child = ElementTree.SubElement(parent, _tag(name))
    child.text = text
    return child
