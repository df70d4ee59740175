"""The environment with which a process joins the link, set before rclpy is imported, and the Fast
DDS profile that it names: ROS stays on the loopback interface.

Standard library only: every process imports this while it discovers plugins. Source: Fast DDS 2.14
XML profiles.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path

from rn_link.machine import DISCOVERY_PORT, LOOPBACK, PROFILE, RELAY, link_folder, read_machine
from roboneuron import ConfigurationError, foreign

log = logging.getLogger(__name__)
VARIABLE = "FASTRTPS_DEFAULT_PROFILES_FILE"
RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
OTHERS = (
    "FASTDDS_DEFAULT_PROFILES_FILE",
    "FASTDDS_BUILTIN_TRANSPORTS",
    "ROS_DISCOVERY_SERVER",
    "ROS_STATIC_PEERS",
    "ROS_LOCALHOST_ONLY",
)
"""Variables that would make ROS bypass the link."""
_SHIPPED = files("roboneuron") / "data" / "fastdds.xml"
SWITCH = "ROBONEURON_LINK"
"""Environment variable; "off" keeps a process on this machine."""
_BUFFER_BYTES = 4_194_304
"""Size of a participant's UDP socket buffer: an image arrives as many datagrams at once."""
_BUFFER_LIMIT = Path("/proc/sys/net/core/rmem_max")
_UDP, _BUILTIN = "<type>UDPv4</type>", "</builtin>"
"""Places of the shipped profile."""


def join_link() -> None:
    """Let this process and its children use the link of this machine, if it has one.

    Nothing is changed if a variable of the user conflicts with the link, or the link cannot be
    used: ROS then stays on this machine, and `LinkFeature.check` reports the reason.
    """
    folder = link_folder()
    try:
        machine = read_machine(folder)
        if machine is not None and machine.peers and os.environ.get(SWITCH) != "off":
            check_unopposed(os.environ, folder)
            os.environ[VARIABLE] = str(write_profile(folder))
            # LOCALHOST, the project's default, would replace the profile's peers; the profile
            # restricts ROS likewise
            os.environ[RANGE] = "SYSTEM_DEFAULT"
    except ConfigurationError as error:
        log.warning("This process does not use the link: %s", error)


def uses_link() -> bool:
    """True if this process has joined the link."""
    return os.environ.get(VARIABLE) == str(link_folder() / PROFILE)


def check_unopposed(environment: Mapping[str, str], folder: Path) -> None:
    """Check that no variable of the user conflicts with the link.

    Raises:
        ConfigurationError: names the variable.
    """
    allowed = {
        VARIABLE: {str(folder / PROFILE), str(_SHIPPED)},
        "RMW_IMPLEMENTATION": {"rmw_fastrtps_cpp"},
    }
    wrong = [
        name
        for name, values in allowed.items()
        if environment.get(name) and environment[name] not in values
    ]
    wrong += [name for name in OTHERS if environment.get(name)]
    if wrong:
        raise ConfigurationError(
            f"{wrong[0]} is {environment[wrong[0]]!r}, and the link between machines needs its own "
            "setting.",
            hint=f"Unset {' and '.join(wrong)}, or remove the link with `roboneuron link remove`.",
        )


def write_profile(folder: Path) -> Path:
    """Return the link's profile, which replaces that of an earlier version.

    Raises:
        ConfigurationError: it cannot be written, or the shipped profile is of another form.
    """
    path, text = folder / PROFILE, fast_dds_profile()
    try:
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            foreign.write_private(path, text)
    except OSError as error:
        raise ConfigurationError(f"{path} cannot be written: {error}.") from error
    return path


def fast_dds_profile() -> str:
    """Return the shipped profile with UDP restricted to the loopback interface, and the relay as a
    peer.

    Processes of one machine find each other by UDP on the loopback interface, as without a link.

    Raises:
        ConfigurationError: the shipped profile is of another form.
    """
    shipped = _SHIPPED.read_text(encoding="utf-8")
    if [shipped.count(place) for place in (_UDP, _BUILTIN)] != [1, 1]:
        raise ConfigurationError(f"{_SHIPPED} does not have {_UDP} and {_BUILTIN} once.")
    size = min(_BUFFER_BYTES, int(_BUFFER_LIMIT.read_text(encoding="ascii")))
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
