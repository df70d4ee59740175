"""Metadata of the packages: Python versions, bounds, and valid addresses."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
PROJECTS = [
    ROOT / "roboneuron-core" / "pyproject.toml",
    ROOT / "pyproject.toml",
    *sorted(ROOT.glob("plugins/rn-*/pyproject.toml")),
]


@pytest.fixture(
    params=PROJECTS, ids=lambda path: path.parent.name if path.parent != ROOT else "roboneuron"
)
def project(request: pytest.FixtureRequest) -> dict[str, Any]:
    facts: dict[str, Any] = tomllib.loads(request.param.read_text(encoding="utf-8"))["project"]
    return facts


def test_each_supported_python_has_a_classifier(project: dict[str, Any]) -> None:
    versions = [
        c.rpartition(" :: ")[2]
        for c in project["classifiers"]
        if c.startswith("Programming Language")
    ]
    assert versions == ["3", "3.11", "3.12", "3.13"]
    assert project["requires-python"] == ">=3.11"


def test_packages_of_the_project_are_bounded_by_the_next_incompatible_version(
    project: dict[str, Any],
) -> None:
    extras = [need for needs in project.get("optional-dependencies", {}).values() for need in needs]
    own = [
        need
        for need in (*project["dependencies"], *extras)
        if re.match(r"rn-|roboneuron-core(?!\[)", need)
    ]
    assert all(need.endswith(">=0.1,<0.2") for need in own), own


def test_libraries_whose_next_major_version_breaks_have_an_upper_bound() -> None:
    core = tomllib.loads(PROJECTS[0].read_text(encoding="utf-8"))["project"]
    assert "mcp>=2.3,<3" in core["dependencies"]


def test_addresses_are_real_or_absent(project: dict[str, Any]) -> None:
    urls = project.get("urls", {})
    assert all(re.match(r"https://(?!.*example\.)", url) for url in urls.values())
