"""Check that a single ROS installation is used: the files that a process loads, and the origin of
others.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Protocol

from rn_standard.doctor.finding import Finding, failed, ok

_ROS_S = 30.0
_PROBE = """
import json, rclpy
rclpy.init()
from std_msgs.msg import String
rclpy.create_node("roboneuron_doctor_libraries").create_publisher(String, "~/nothing", 1)
rclpy.shutdown()
with open("/proc/self/maps") as maps:
    paths = {line.split(maxsplit=5)[-1].strip() for line in maps if ".so" in line}
print(json.dumps({"module": rclpy.__file__, "libraries": sorted(paths)}))
"""
_OF_ROS = re.compile(r"lib(fastrtps|fastdds|fastcdr|rcl|rmw|rosidl_typesupport)[a-z_]*\.so")
_OF_DDS = re.compile(r"lib(fastrtps|fastdds)\.so")
_MARKS = {"LD_LIBRARY_PATH": "librcl.so", "PYTHONPATH": "rclpy/__init__.py"}
"""File by which a folder of a ROS installation is recognised, by the variable that contains the
folder.
"""


class UsedInstallation(Protocol):
    """Result of `prepare_environment`: the installation in use."""

    @property
    def choice(self) -> tuple[str, str]:
        """Its kind, and the reason for the choice."""

    @property
    def roots(self) -> tuple[Path, ...]:
        """Its folders."""


def look(used: UsedInstallation) -> Finding:
    """Report the installation of this environment, or mixed parts with a remedy."""
    roots = used.roots
    foreign = foreign_folders(os.environ, roots)
    if foreign:
        listed = ", ".join(f"{folder} by {name}" for name, folder in foreign)
        variables = " ".join(sorted({name for name, _ in foreign}))
        return failed(
            f"Another ROS would be mixed with that of {roots[0]}: {listed}.",
            f"Type: unset {variables}",
        )
    found = _loaded()
    if isinstance(found, str):
        return failed(
            f"rclpy cannot be used: {found}",
            "Try it from a shell without PYTHONPATH, LD_LIBRARY_PATH, AMENT_PREFIX_PATH and "
            "RMW_IMPLEMENTATION; then "
            "install roboneuron-core again.",
        )
    module, libraries = found
    if problem := mixed(libraries, roots):
        return failed(
            f"{problem}.",
            "Type: unset LD_LIBRARY_PATH PYTHONPATH AMENT_PREFIX_PATH; or source one setup.bash "
            "in a new shell.",
        )
    domain = os.environ.get("ROS_DOMAIN_ID") or "0"
    reach = os.environ.get(
        "ROS_AUTOMATIC_DISCOVERY_RANGE", "as ROS_DISCOVERY_SERVER or ROS_STATIC_PEERS say"
    )
    return ok(
        f"rclpy from {module.parent}, domain {domain}, discovery range {reach}; "
        f"{': '.join(used.choice)}."
    )


def foreign_folders(
    environment: Mapping[str, str], roots: Iterable[Path]
) -> tuple[tuple[str, str], ...]:
    """Folders with libraries or modules of another ROS, each with the variable that contains it.

    Args:
        environment: environment of the process.
        roots: folders of the installation in use, and of workspaces over it.
    """
    own = tuple(roots)
    return tuple(
        (name, folder)
        for name, mark in _MARKS.items()
        for folder in environment.get(name, "").split(os.pathsep)
        if folder
        and Path(folder, mark).exists()
        and not any(Path(folder).is_relative_to(root) for root in own)
    )


def mixed(libraries: Iterable[Path], roots: Iterable[Path]) -> str:
    """Describe the fault in the libraries loaded by one process; empty without one.

    Args:
        libraries: files.
        roots: folders of the installation in use, and of workspaces over it.
    """
    real = {path.resolve() for path in libraries if _OF_ROS.match(path.name)}
    middleware = sorted(str(path) for path in real if _OF_DDS.match(path.name))
    if len(middleware) > 1:
        return f"One process loads more than one Fast DDS: {' and '.join(middleware)}"
    inside = [root.resolve() for root in roots]
    foreign = sorted(
        str(path) for path in real if not any(path.is_relative_to(root) for root in inside)
    )
    if foreign:
        return f"One process loads libraries from outside {inside[0]}: {', '.join(foreign[:3])}"
    return ""


def _loaded() -> tuple[Path, list[Path]] | str:
    """File of rclpy and the libraries that it loads, or the reason why it does not start. Evaluated
    in a separate process, because rcl may end it.
    """
    command = [sys.executable, "-P", "-c", _PROBE]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, errors="replace", timeout=_ROS_S, check=False
        )
    except subprocess.TimeoutExpired:
        return f"it did not start within {_ROS_S:g} s."
    lines = [line.strip() for line in (done.stderr or done.stdout).splitlines() if line.strip()]
    if done.returncode != 0:
        return lines[-1] if lines else f"exit status {done.returncode}."
    facts = json.loads(done.stdout.splitlines()[-1])
    return Path(facts["module"]), [Path(one) for one in facts["libraries"]]
