"""The simulated robots require exactly one physics engine on each Python version: one with a wheel
for it.

`make test-pythons` checks that it runs, with an environment for each version.
"""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
# Wheels for Linux on the package index, 2026-11: pybullet 3.2.7 cp311 (x86_64 only); mujoco 3.17.0
# cp311 - cp314.
PLACES = [
    ("3.11", "x86_64", "pybullet"),
    ("3.12", "x86_64", "mujoco"),
    ("3.13", "x86_64", "mujoco"),
    ("3.11", "aarch64", "mujoco"),
]


@pytest.mark.parametrize("package", ["rn-robot-fr3", "rn-robot-bases"])
@pytest.mark.parametrize(("version", "machine", "engine"), PLACES)
def test_the_engine_that_pip_installs_has_a_wheel(
    package: str, version: str, machine: str, engine: str
) -> None:
    project = tomllib.loads((ROOT / "plugins" / package / "pyproject.toml").read_text())["project"]
    place = {"python_version": version, "platform_machine": machine}
    needed = [Requirement(line) for line in project["dependencies"]]
    installed = {r.name for r in needed if r.marker is None or r.marker.evaluate(place)}
    assert installed & {"pybullet", "mujoco"} == {engine}
    assert f"Programming Language :: Python :: {version}" in project["classifiers"]
