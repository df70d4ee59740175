"""Choice of the ROS 2 installation: the wheels of this environment, or one whose `setup.bash` is
sourced in the shell; never parts of both.

Source: the setup files of ament put the installation before AMENT_PREFIX_PATH, LD_LIBRARY_PATH,
PYTHONPATH and PATH; the ros-python-wheels bootstrapper adds the wheels' libraries to
LD_LIBRARY_PATH at each start of Python that has no guard variable.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

from roboneuron import foreign
from roboneuron.errors import ConfigurationError, ForeignDataError

Installation = Literal["auto", "wheels", "sourced"]
"""Values of `[ros] installation`."""
BOOTSTRAP_GUARD = "_ROS_WHEELS_BOOTSTRAP_COMPLETE"
CHOICE = "ROBONEURON_ROS"
"""Environment variable with the choice and its reason, if a ROS installation is sourced."""
_PREFIXES = "AMENT_PREFIX_PATH"
_LIBRARIES = "LD_LIBRARY_PATH"
_MODULES = "PYTHONPATH"
_RCLPY = "lib/python3.*/*-packages/rclpy"
_LEAST_PYTHON = (3, 12)
"""Python version of Jazzy and later; earlier versions of rclpy have another interface."""
_OWN_PYTHON = sys.version_info[:2]


class Sourced(NamedTuple):
    """A sourced ROS installation.

    Attributes:
        prefix: prefix that contains rclpy.
        distribution: such as kilted.
        python: Python version of its rclpy.
        prefixes: this prefix and the workspaces over it.
    """

    prefix: Path
    distribution: str
    python: tuple[int, int]
    prefixes: tuple[Path, ...]

    def __str__(self) -> str:
        return f"ROS {self.distribution} of {self.prefix}"


class Choice(NamedTuple):
    """An installation, and the reason for the choice."""

    installation: Literal["wheels", "sourced"]
    reason: str


def find_sourced(environment: Mapping[str, str], prefix: str) -> Sourced | None:
    """Find the sourced installation: the first prefix with an rclpy that is not a virtual
    environment.
    """
    others = {Path(prefix), *_other_wheels(environment, prefix)}
    foreign = [path for path in map(Path, _split(environment, _PREFIXES)) if path not in others]
    for found in foreign:
        for package in sorted(found.glob(_RCLPY)):
            major, _, minor = package.parents[1].name.removeprefix("python").partition(".")
            return Sourced(
                found,
                environment.get("ROS_DISTRO") or found.name,
                (int(major), int(minor)),
                tuple(foreign),
            )
    return None


def choose(
    wanted: Installation, sourced: Sourced | None, python: tuple[int, int] = _OWN_PYTHON
) -> Choice:
    """Choose the installation.

    Args:
        wanted: set in the configuration.
        sourced: the sourced installation.
        python: version of this process's Python.

    Raises:
        ConfigurationError: the sourced installation is wanted but unusable; names a remedy.
    """
    if wanted == "wheels":
        return Choice("wheels", 'the configuration says installation = "wheels"')
    if sourced is None:
        if wanted == "sourced":
            raise ConfigurationError(
                '[ros] installation is "sourced", but no ROS installation is sourced.',
                hint="Type `source /opt/ros/DISTRIBUTION/setup.bash` and start again, or set "
                'installation = "wheels".',
            )
        return Choice("wheels", "no ROS installation is sourced in this shell")
    theirs, ours = (".".join(map(str, version)) for version in (sourced.python, python))
    if sourced.python == python and python >= _LEAST_PYTHON:
        return Choice("sourced", f"{sourced} is sourced, for this Python {ours}")
    problem = f"{sourced} is for Python {theirs}, and this is Python {ours}"
    if wanted == "sourced":
        hint = (
            f"Install RoboNeuron with python{theirs}"
            if sourced.python >= _LEAST_PYTHON
            else "RoboNeuron needs Python 3.12 or newer for a sourced ROS (Jazzy or later)"
        )
        raise ConfigurationError(f"{problem}.", hint=f'{hint}, or set installation = "wheels".')
    return Choice("wheels", problem)


def arranged(
    environment: Mapping[str, str], prefix: str, sourced: Sourced, choice: Choice
) -> dict[str, str]:
    """Return an environment with the chosen installation only.

    Args:
        environment: environment of the process.
        prefix: the virtual environment that contains the ROS wheels.
        sourced: the sourced installation.
        choice: the chosen one.
    """
    found = {**environment, CHOICE: f"{choice.installation}: {choice.reason}"}
    if choice.installation == "sourced":
        found[BOOTSTRAP_GUARD] = "1"  # otherwise the wheels' libraries come back
        _leave_out(found, _LIBRARIES, [Path(prefix)])
        return found
    for name in (_PREFIXES, _LIBRARIES, _MODULES):
        _leave_out(found, name, sourced.prefixes)
    found.pop("ROS_DISTRO", None)
    return found


def check_not_mixed(environment: Mapping[str, str], prefix: str) -> None:
    """Refuse a sourced installation, or wheels of another environment, beside the libraries of the
    wheels.

    Raises:
        ConfigurationError: explains the correct start.
    """
    for other in _other_wheels(environment, prefix):
        raise ConfigurationError(
            f"A process that uses the ROS wheels of {other} has started this one, and they would "
            f"be mixed with those of {prefix}.",
            hint="Start it by the command `roboneuron`, which keeps them apart, or without "
            f"{_PREFIXES}, {_LIBRARIES} and {BOOTSTRAP_GUARD}.",
        )
    sourced = find_sourced(environment, prefix)
    if sourced is None:
        return
    choice = chosen(environment)
    alone = arranged(environment, prefix, sourced, choice)
    if choice.installation == "sourced" and alone == dict(environment):
        return
    raise ConfigurationError(
        f"{sourced} is sourced in this shell and would be mixed with the ROS wheels of {prefix}.",
        hint="Start it by the command `roboneuron`, which keeps them apart, or from a shell "
        "without `source .../setup.bash`.",
    )


def keep_apart(words: Sequence[str]) -> None:
    """Restart this process with the environment of one installation only, if another one is sourced
    in the shell or comes from the parent process; otherwise do nothing.

    Args:
        words: words of the command line, which may include `--config FILE`.

    Raises:
        ConfigurationError: as `choose`.
    """
    environment = dict(os.environ)
    others = _other_wheels(environment, sys.prefix)
    if others:
        environment.pop(BOOTSTRAP_GUARD, None)  # this environment's libraries replace them
        for name in (_PREFIXES, _LIBRARIES, _MODULES):
            _leave_out(environment, name, others)
    sourced = find_sourced(environment, sys.prefix)
    if sourced is not None:
        choice = choose(_wanted(words), sourced)
        environment = arranged(environment, sys.prefix, sourced, choice)
    if environment != dict(os.environ):
        os.execve(sys.executable, sys.orig_argv, environment)


def chosen(environment: Mapping[str, str]) -> Choice:
    """The choice for this process, made by `keep_apart`, or the default if nothing is sourced."""
    installation, _, reason = environment.get(CHOICE, "").partition(": ")
    if installation == "sourced":
        return Choice("sourced", reason)
    return Choice("wheels", reason) if installation else choose("auto", None)


class InUse(NamedTuple):
    """The installation used by a process.

    Attributes:
        choice: the choice with its reason.
        roots: folders of the installation and of the workspaces over it.
    """

    choice: Choice
    roots: tuple[Path, ...]


def in_use(environment: Mapping[str, str], prefix: str, wanted: Installation) -> InUse:
    """Return the installation of an environment.

    Raises:
        ConfigurationError: as `choose`.
    """
    sourced = find_sourced(environment, prefix)
    choose(wanted, sourced)
    return InUse(chosen(environment), sourced.prefixes if sourced else (Path(prefix),))


def _other_wheels(environment: Mapping[str, str], prefix: str) -> list[Path]:
    """Virtual environments whose ROS wheels are inherited from the parent process."""
    own = Path(prefix).resolve()
    return [
        found
        for found in map(Path, _split(environment, _PREFIXES))
        if found.resolve() != own and (found / "pyvenv.cfg").exists() and any(found.glob(_RCLPY))
    ]


def _wanted(words: Sequence[str]) -> Installation:
    """Read the wanted installation from a configuration on the command line; errors in it are left
    to its reader.
    """
    known: tuple[Installation, ...] = ("wheels", "sourced")
    for word, following in zip(words, [*words, ""][1:], strict=True):
        name, _, value = word.partition("=")
        if name != "--config":
            continue
        try:
            text = foreign.read_text(Path(value or following), most_bytes=foreign.MOST_BYTES)
            table = foreign.decode_toml(text, "the configuration").get("ros")
        except (OSError, ValueError, ForeignDataError):
            break
        wanted = table.get("installation") if isinstance(table, dict) else None
        return next((one for one in known if one == wanted), "auto")
    return "auto"


def _leave_out(environment: dict[str, str], name: str, prefixes: Sequence[Path]) -> None:
    """Remove entries below some folders from a path variable."""
    kept = [
        folder
        for folder in _split(environment, name)
        if not any(Path(folder).is_relative_to(prefix) for prefix in prefixes)
    ]
    environment.pop(name, None)
    if kept:
        environment[name] = os.pathsep.join(kept)


def _split(environment: Mapping[str, str], name: str) -> list[str]:
    return [folder for folder in environment.get(name, "").split(os.pathsep) if folder]
