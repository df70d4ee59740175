"""The Fast DDS profile of a machine of the link: ROS stays on the loopback interface.

Source: Fast DDS 2.14 XML profiles.
"""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from xml.etree import ElementTree

from rn_link.machine import DISCOVERY_PORT, LOOPBACK, RELAY

NAMESPACE = "http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles"
BUFFER_BYTES = 4_194_304
"""Size of a participant's UDP socket buffer: an image arrives as many datagrams at once."""
LIMIT = Path("/proc/sys/net/core/rmem_max")


def fast_dds_profile() -> str:
    """Return the shipped profile with UDP restricted to the loopback interface, and the relay as a
    peer.

    Processes of one machine find each other by UDP on the loopback interface, as without a link.
    """
    ElementTree.register_namespace("", NAMESPACE)
    shipped = files("roboneuron").joinpath("data/fastdds.xml").read_text(encoding="utf-8")
    root = ElementTree.fromstring(shipped)
    for transport in _child(root, "transport_descriptors"):
        if _child(transport, "type").text == "UDPv4":
            _add(transport, "receiveBufferSize", str(receive_buffer_bytes()))
            _add(_add(transport, "interfaceWhiteList"), "address", LOOPBACK)
    rtps = _child(_child(root, "participant"), "rtps")
    _child(rtps, "builtin").append(_initial_peers())
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def receive_buffer_bytes() -> int:
    """Largest size that this machine's kernel allows, at most BUFFER_BYTES."""
    return min(BUFFER_BYTES, int(LIMIT.read_text(encoding="ascii")))


def _initial_peers() -> ElementTree.Element:
    peers = ElementTree.Element(_tag("initialPeersList"))
    relay = _add(_add(peers, "locator"), "udpv4")
    _add(relay, "address", RELAY)
    _add(relay, "port", str(DISCOVERY_PORT))
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
