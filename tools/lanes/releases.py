"""Wheels, and a dry run of a release."""

from __future__ import annotations

import shutil
import subprocess
import sys

import distributions
import nox

from lanes.environments import ROOT
from lanes.lane import JOBS, lane

TOOLS = ("check-wheel-contents", "cyclonedx-bom", "twine")
PYTHONS = ("python3.11", "python3.12", "python3.13")
NO_TAG = ("HEAD~100", "0.0.1")
"""Without a tag, the commit that stands for the previous release, and the number it gets."""


@lane
def wheels(session: nox.Session) -> None:
    """build a wheel of every package into out/wheels"""
    out = ROOT / "out" / "wheels"
    shutil.rmtree(out, ignore_errors=True)
    for folder in distributions.projects():
        with session.chdir(folder):
            session.run(sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(out))


@lane
def release(session: nox.Session) -> None:
    """a dry run into out/release: build twice, check, try on each Python (ARGS=python3.11)"""
    constraints = ("--constraint", str(ROOT / "constraints.txt"))
    session.run(sys.executable, "-m", "pip", "install", "--quiet", *constraints, *TOOLS)
    out, build = ROOT / "out" / "release", (sys.executable, "tools/release.py")
    shutil.rmtree(out, ignore_errors=True)
    dist, before = out / "dist", out / "before"
    session.run(*build, str(dist))
    revision, number = previous()
    session.run(*build, str(before), "--revision", revision, "--renumber", number, "--whole")
    file = "tests/test_packages_build_wheels.py"
    found = {"RELEASE_WHEELS": str(dist)}
    session.run(*(sys.executable, "-m", "pytest", "-n", JOBS, "-m", "release", file), env=found)
    bill = out / f"roboneuron-{distributions.version_of()}.cdx.json"
    places = (str(dist), "--before", str(before), "--sbom", str(bill))
    pythons = session.posargs or PYTHONS
    session.run(sys.executable, "tests/pythons/wheels.py", *places, *pythons)
    session.run(sys.executable, "tools/licences.py", str(bill))
    tag = f"v{distributions.version_of()}"
    session.log(f"Nothing was uploaded. Before the tag {tag}:")
    for fault in distributions.faults_of_tag(tag):
        session.log(f"  {fault}")


def previous() -> tuple[str, str]:
    """The newest tag before the present version, and its number."""
    command = ["git", "tag", "--list", "v*", "--sort=-version:refname"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    tags = [tag for tag in done.stdout.split() if tag != f"v{distributions.version_of()}"]
    return (tags[0], tags[0].removeprefix("v")) if tags else NO_TAG
