"""Defaults that make ROS 2 from pip wheels work on a laptop; variables set by the user are kept.

Source of the facts: the ros-python-wheels bootstrapper leaves AMENT_PREFIX_PATH unset.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Collection, MutableMapping, Sequence
from importlib import import_module, util
from importlib.resources import files
from pathlib import Path
from tempfile import TemporaryFile

from roboneuron.errors import ConfigurationError
from roboneuron.log_files import make_log_directory
from roboneuron.ros.installation import (
    BOOTSTRAP_GUARD,
    Installation,
    InUse,
    Sourced,
    check_not_mixed,
    find_sourced,
    in_use,
)

CLIENT_TOKEN = "ROBONEURON_TOKEN"
"""Environment variable with the bearer token of `roboneuron call --url` and similar commands, if no
other is named.
"""
PORT_OFFSET = "ROBONEURON_PORT_OFFSET"
"""Offset of a process's data ports from the first port of its domain; the shipped profile
reads it.
"""
PARTICIPANTS = "ROBONEURON_PARTICIPANTS"
"""Number of participants of this host probed by LOCALHOST discovery; the shipped profile
reads it.
"""
_PROFILE_OF_2, _PROFILE_OF_3 = "FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE"
"""Names in Fast DDS 2 and 3 of the variable with their profile."""
_INSTEAD = {
    "ROS_AUTOMATIC_DISCOVERY_RANGE": (
        "ROS_DISCOVERY_SERVER",
        "ROS_STATIC_PEERS",
        "ROS_LOCALHOST_ONLY",
    ),
    _PROFILE_OF_2: (_PROFILE_OF_3, "FASTDDS_BUILTIN_TRANSPORTS"),
    _PROFILE_OF_3: ("FASTDDS_BUILTIN_TRANSPORTS",),
}
"""Alternative variables with which a user sets the same; if one is set, there is no default."""
_GENERATOR = "rosidl_generator_py.generate_py_impl"
"""Generator of the interfaces' Python classes, which runs in separate processes."""
_STANDARD_OFFSET = 11
"""Standard offset of the data ports within a domain. Source: RTPS 2.2, 9.6.1.1."""
MAX_DOMAIN = 232
"""The highest domain whose ports are below 65536."""
_SLOTS = tuple(250 * block + slot for block in range(5) for slot in (131, 163, 195))
"""Offsets of blocks of 16 ports, above those of the first 60 participants of a domain, so that they
do not collide.
"""


def fast_dds_profile() -> Path:
    """The shipped Fast DDS profile: shared memory with a 32 MiB segment, and UDP."""
    return Path(str(files("roboneuron").joinpath("data/fastdds.xml")))


def state_directory(configured: str | None = None) -> Path:
    """Directory of the logs, the emergency-stop latch and the audit: `configured`, else the XDG
    state directory.
    """
    if configured:
        return Path(configured).expanduser()
    base = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    return Path(base) / "roboneuron"


def check_state_directory(directory: Path) -> None:
    """Create the directory if necessary, and test that it is writable.

    Raises:
        ConfigurationError: it is not; names the directory and a remedy.
    """
    try:
        make_log_directory(directory)
        with TemporaryFile(dir=directory):
            pass
    except OSError as error:
        raise ConfigurationError(
            f"The state directory {directory} cannot be written: {error.strerror or error}.",
            hint="It keeps logs, the emergency stop and the audit. Make it writable, or name "
            "another one with "
            "state_directory in [supervisor], or with XDG_STATE_HOME.",
        ) from error


def set_defaults(
    environment: MutableMapping[str, str], *, prefix: str, log_directory: Path
) -> None:
    """Set default values for unset variables.

    Args:
        environment: changed in place.
        prefix: the virtual environment that holds the ROS wheels.
        log_directory: where rcl writes its logs.

    Raises:
        ConfigurationError: a sourced ROS installation is mixed with the wheels of this environment,
            or a variable has a value for which rcl would end this process.
    """
    check_not_mixed(environment, prefix)
    _check_domain(environment.get("ROS_DOMAIN_ID", ""))
    sourced = find_sourced(environment, prefix)
    prefixes = [Path(p) for p in environment.get("AMENT_PREFIX_PATH", "").split(":") if p]
    installed = prefixes if sourced else [Path(prefix), *prefixes]
    _check_middleware(environment.get("RMW_IMPLEMENTATION", ""), installed)
    defaults = {
        "AMENT_PREFIX_PATH": prefix,
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        _profile_variable(sourced): str(fast_dds_profile()),
        PORT_OFFSET: str(_STANDARD_OFFSET),
        PARTICIPANTS: "32",
        "ROS_LOG_DIR": str(log_directory),
    }
    for name, value in defaults.items():
        if environment.keys().isdisjoint(_INSTEAD.get(name, ())):
            environment.setdefault(name, value)


def _profile_variable(sourced: Sourced | None) -> str:
    """Name of the variable with the Fast DDS profile: the library of version 3 is named
    `libfastdds`.
    """
    libraries = sourced.prefix.glob("lib/**/libfastdds.so*") if sourced else iter(())
    return _PROFILE_OF_2 if next(libraries, None) is None else _PROFILE_OF_3


def _check_domain(domain: str) -> None:
    """Refuse an invalid domain: rcl would end the process without naming the cause.

    Source: RTPS 2.2, 9.6.1.1: ports of higher domains lie above 65535.

    Raises:
        ConfigurationError: names the range.
    """
    if domain and not (domain.isascii() and domain.isdecimal() and int(domain) <= MAX_DOMAIN):
        raise ConfigurationError(
            f"ROS_DOMAIN_ID is {domain!r}, expected a whole number from 0 to {MAX_DOMAIN}.",
            hint="Set it to one, or unset it for 0.",
        )


def _check_middleware(name: str, prefixes: Sequence[Path]) -> None:
    """Check that RMW_IMPLEMENTATION is installed, by the ament index."""
    indexes = [prefix / "share/ament_index/resource_index/rmw_typesupport" for prefix in prefixes]
    known = {entry.name for index in indexes if index.is_dir() for entry in index.iterdir()} - {
        "rmw_implementation"
    }
    if name and known and name not in known:
        raise ConfigurationError(
            f"RMW_IMPLEMENTATION is {name!r}, which is not installed in this environment.",
            hint=f"Unset it, or choose one of: {', '.join(sorted(known))}.",
        )


def _check_not_hidden(prefix: str) -> None:
    """Refuse another rclpy on the import path before that of this environment, or of the sourced
    installation; PYTHONPATH may cause that.
    """
    try:
        spec = util.find_spec("rclpy")
    except ValueError:  # a stand-in without a spec
        return
    found = Path(spec.origin).parent if spec is not None and spec.origin else None
    sourced = find_sourced(os.environ, prefix)
    if found is None or found.is_relative_to(sourced.prefix if sourced else prefix):
        return
    own = [
        Path(entry) / "rclpy" for entry in sys.path if entry and Path(entry).is_relative_to(prefix)
    ]
    if any(folder.is_dir() for folder in own):
        raise ConfigurationError(
            f"rclpy would be imported from {found}, which hides the one of {prefix}.",
            hint=f"PYTHONPATH is {os.environ.get('PYTHONPATH', '')!r}: unset it, or take that "
            "folder out.",
        )


class _Generator:
    """Stands for the generator until it is called. Every message imports the package of its
    generator, and the generator its parser of interface definitions, which takes a thirtieth of a
    server's start.
    """

    @staticmethod
    def generate_py(*arguments: object, **named: object) -> object:
        """As the generator's, which is imported now."""
        if sys.modules[_GENERATOR] is _Generator:  # type: ignore[comparison-overlap]
            del sys.modules[_GENERATOR]
        return import_module(_GENERATOR).generate_py(*arguments, **named)


def prepare_environment(
    log_directory: Path | None = None, *, wanted: Installation = "auto"
) -> InUse:
    """Set this process's defaults; call it before rclpy is imported.

    Args:
        log_directory: where rcl writes its logs; below the state directory when None.
        wanted: installation set in the configuration.

    Returns:
        The ROS installation of this process.

    Raises:
        ConfigurationError: as `set_defaults` and `choose`, or another rclpy precedes the one of
            this environment.
    """
    used = in_use(os.environ, sys.prefix, wanted)
    set_defaults(
        os.environ,
        prefix=sys.prefix,
        log_directory=log_directory or state_directory() / "log" / "ros",
    )
    _check_not_hidden(sys.prefix)
    sys.modules.setdefault(_GENERATOR, _Generator)  # type: ignore[arg-type]
    return used


def port_offset(domain: int, start: int) -> int:
    """Offset of the data ports of the `start`-th module process, distinct from those of the 14
    before it.

    A sender keeps opening the port of a killed process until its lease ends (20 s). If a successor
    opens the same port meanwhile, Fast DDS 2.14 can lose it: the successor never receives anything
    from that sender.

    Source: RTPS 2.2, 9.6.1.1 (port = 7400 + 250 * domain + offset + 2 * participant; the standard
    offset is 11).
    """
    slots = [slot for slot in _SLOTS if 7400 + 250 * domain + slot + 32 < 2**16]
    return slots[start % len(slots)] if slots else _STANDARD_OFFSET


def module_environment(
    python: str | None, start: int, secrets: Collection[str] = ()
) -> dict[str, str]:
    """Environment for the `start`-th module process, run by `python` (None: this interpreter).

    It excludes the variables in `secrets` and the token of RoboNeuron's own client.

    Another interpreter has its own ROS libraries: variables that refer to this one's are removed,
    so that its bootstrapper runs.
    """
    environment = {
        name: value for name, value in os.environ.items() if name not in (CLIENT_TOKEN, *secrets)
    }
    domain = environment.get("ROS_DOMAIN_ID", "")
    environment[PORT_OFFSET] = str(port_offset(int(domain) if domain.isdecimal() else 0, start))
    if python is not None and Path(python).absolute() != Path(sys.executable).absolute():
        for key in (BOOTSTRAP_GUARD, "LD_LIBRARY_PATH", "AMENT_PREFIX_PATH", "PYTHONPATH"):
            environment.pop(key, None)
    return environment
