"""The Fast DDS profile of a machine of the link: ROS stays on the loopback interface.

Source: Fast DDS 2.14 XML profiles.
"""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

from rn_link.machine import DISCOVERY_PORT, LOOPBACK, RELAY

BUFFER_BYTES = 4_194_304
"""Size of a participant's UDP socket buffer: an image arrives as many datagrams at once."""
LIMIT = Path("/proc/sys/net/core/rmem_max")
_UDP = "<type>UDPv4</type>"
_BUILTIN = "</builtin>"
"""Places of the shipped profile."""


def fast_dds_profile() -> str:
    """Return the shipped profile with UDP restricted to the loopback interface, and the relay as a
    peer.

    Processes of one machine find each other by UDP on the loopback interface, as without a link.

    Raises:
        LookupError: the shipped profile is of another form.
    """
    shipped = files("roboneuron").joinpath("data/fastdds.xml").read_text(encoding="utf-8")
    for place in (_UDP, _BUILTIN):
        if shipped.count(place) != 1:
            raise LookupError(f"the shipped profile has {place} {shipped.count(place)} times")
    size = min(BUFFER_BYTES, int(LIMIT.read_text(encoding="ascii")))
    udp = f"""{_UDP}
      <receiveBufferSize>{size}</receiveBufferSize>
      <interfaceWhiteList><address>{LOOPBACK}</address></interfaceWhiteList>"""
    relay = f"<address>{RELAY}</address><port>{DISCOVERY_PORT}</port>"
    peers = f"""<initialPeersList>
          <locator><udpv4>{relay}</udpv4></locator>
          <locator><udpv4><address>{LOOPBACK}</address></udpv4></locator>
        </initialPeersList>
      {_BUILTIN}"""
    return shipped.replace(_UDP, udp).replace(_BUILTIN, peers)
