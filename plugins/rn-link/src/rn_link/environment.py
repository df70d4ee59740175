"""The environment with which a process joins the link; set before rclpy is imported.

Standard library alone: every process imports this while it discovers plugins.
"""

from __future__ import annotations

import fcntl
import logging
import os
from collections.abc import Mapping, MutableMapping
from importlib.resources import files
from pathlib import Path

from rn_link.machine import Machine, link_folder, read_machine
from roboneuron import ConfigurationError

log = logging.getLogger(__name__)
PROFILE = "FASTRTPS_DEFAULT_PROFILES_FILE"
OPENSSL = "OPENSSL_CONF"
RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
OTHERS = (
    "FASTDDS_DEFAULT_PROFILES_FILE",
    "FASTDDS_BUILTIN_TRANSPORTS",
    "ROS_DISCOVERY_SERVER",
    "ROS_STATIC_PEERS",
    "ROS_LOCALHOST_ONLY",
)
"""Variables that lead ROS past the link."""
_SHIPPED = files("roboneuron") / "data" / "fastdds.xml"
SWITCH = "ROBONEURON_LINK"
"""Environment variable; "off" leaves a member's link to another process."""
_HOLDER = "ROBONEURON_LINK_HOLDER"
"""Process that has the port of a member; what it starts inherits the variable."""


def join_link() -> None:
    """Let this process, and what it starts, use the link of this machine, if it has one.

    One process of a member has its port; the others hear only this machine. Nothing is changed when
    the user has set what contradicts the link, or the link cannot be used: ROS then stays on this
    machine, and `LinkFeature.check` says why.
    """
    folder = link_folder()
    try:
        machine = read_machine(folder)
        if machine is not None and machine.peers and os.environ.get(SWITCH) != "off":
            set_link(os.environ, machine, folder)
    except ConfigurationError as error:
        log.warning("This process does not use the link: %s", error)


def set_link(environment: MutableMapping[str, str], machine: Machine, folder: Path) -> None:
    """Set what a process of this machine needs; nothing in a member whose port is taken.

    Raises:
        ConfigurationError: the user has set what contradicts it.
    """
    check_unopposed(environment, folder)
    if machine.role == "member" and environment.get(_HOLDER) != str(os.getpid()):
        if not take_port(folder):
            if _HOLDER in environment:
                leave_link(environment)
            return
        environment[_HOLDER] = str(os.getpid())
    environment[PROFILE] = str(folder / "fastdds.xml")
    environment[OPENSSL] = str(folder / "openssl.cnf")
    # LOCALHOST, the project's default, replaces the peers of the profile, which says the same
    environment[RANGE] = "SYSTEM_DEFAULT"


def leave_link(environment: MutableMapping[str, str]) -> None:
    """Undo `set_link` in a child of the process that has the port."""
    environment[PROFILE] = str(_SHIPPED)
    environment[RANGE] = "LOCALHOST"
    del environment[OPENSSL], environment[_HOLDER]


def check_unopposed(environment: Mapping[str, str], folder: Path) -> None:
    """Check that no variable of the user contradicts the link.

    Raises:
        ConfigurationError: names the variable.
    """
    allowed = {
        PROFILE: {str(folder / "fastdds.xml"), str(_SHIPPED)},
        OPENSSL: {str(folder / "openssl.cnf")},
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


def take_port(folder: Path) -> bool:
    """Whether this process has the member's port now, for as long as it lives."""
    # never closed: the lock is the claim, and ends with the process
    lock = os.open(folder / "port.lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(lock)
        return False
    return True
