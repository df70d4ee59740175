"""The environment with which a process joins the link; set before rclpy is imported.

Standard library only: every process imports this while it discovers plugins.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path

from rn_link.machine import link_folder, read_machine
from roboneuron import ConfigurationError

log = logging.getLogger(__name__)
PROFILE = "FASTRTPS_DEFAULT_PROFILES_FILE"
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
            os.environ[PROFILE] = str(folder / "fastdds.xml")
            # LOCALHOST, the project's default, would replace the profile's peers; the profile
            # restricts ROS likewise
            os.environ[RANGE] = "SYSTEM_DEFAULT"
    except ConfigurationError as error:
        log.warning("This process does not use the link: %s", error)


def uses_link() -> bool:
    """True if this process has joined the link."""
    return os.environ.get(PROFILE) == str(link_folder() / "fastdds.xml")


def check_unopposed(environment: Mapping[str, str], folder: Path) -> None:
    """Check that no variable of the user conflicts with the link.

    Raises:
        ConfigurationError: names the variable.
    """
    allowed = {
        PROFILE: {str(folder / "fastdds.xml"), str(_SHIPPED)},
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
