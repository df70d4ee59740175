"""Check with deptry that each package declares what it imports.

    python tools/dependencies.py [PACKAGE ...]

The tables say which modules the wheels of ROS bring, whose names are others.
"""

from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
ROS = {
    "ros-jazzy-rclpy": (
        "rclpy",
        "rcl_interfaces",
        "action_msgs",
        "unique_identifier_msgs",
        "rosidl_parser",
        "type_description_interfaces",
    ),
    "ros-jazzy-common-interfaces": (
        "builtin_interfaces",
        "diagnostic_msgs",
        "geometry_msgs",
        "nav_msgs",
        "sensor_msgs",
        "std_msgs",
        "std_srvs",
        "trajectory_msgs",
    ),
    "ros-jazzy-lifecycle-msgs": ("lifecycle_msgs",),
}
"""Modules of the wheels that core declares: with core, every plugin has them."""
OTHERS = {"pin": ("pinocchio", "coal", "eigenpy"), "pylibfranka": ("pylibfranka",)}
"""Modules with names of their own in the wheels of others."""


UNUSED = "DEP002"
"""A package may name a plugin that is discovered, or what a library of its own loads; it imports
neither.
"""


def packages() -> list[Path]:
    """Folders of the distributions with code."""
    found = [ROOT / "roboneuron-core", *sorted((ROOT / "plugins").iterdir())]
    return [one for one in found if (one / "src").is_dir() and (one / "pyproject.toml").exists()]


def modules(package: Path) -> tuple[str, ...]:
    """Top-level modules of a package."""
    return tuple(sorted(one.name for one in (package / "src").iterdir() if one.is_dir()))


def name_of(package: Path) -> str:
    """Name of a distribution."""
    return str(tomllib.loads((package / "pyproject.toml").read_text())["project"]["name"])


def main(names: list[str]) -> int:
    """Check the named packages, or all; returns 1 if one fails."""
    own = {name_of(one): modules(one) for one in packages()}
    failed = []
    for package in packages():
        if names and package.name not in names:
            continue
        table = own | OTHERS | ROS
        if package.name != "roboneuron-core":
            table["roboneuron-core"] = sum(ROS.values(), own["roboneuron-core"])
        mapped = ",".join(f"{name}={'|'.join(found)}" for name, found in table.items() if found)
        command = [sys.executable, "-m", "deptry", "--no-ansi", "--ignore", UNUSED, "src"]
        command += ["--package-module-name-map", mapped]
        done = subprocess.run(command, cwd=package, capture_output=True, text=True, check=False)
        if done.returncode:
            failed.append(package.name)
            print(f"{package.name}:\n{done.stderr.strip()}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
