"""All distributions have one version, accept each other in it, and carry the same metadata."""

from __future__ import annotations

import shutil
import tomllib
from collections.abc import Callable
from pathlib import Path

import distributions
import pytest

from roboneuron.plugins.loading import OLD_NAMES_END

CORE, VIEW, FILE = "roboneuron-core", "plugins/rn-view", "pyproject.toml"


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """What the tool reads, of this repository."""
    for folder in distributions.projects():
        place = tmp_path / folder.relative_to(distributions.ROOT)
        place.mkdir(parents=True, exist_ok=True)
        for name in ("pyproject.toml", "LICENSE"):
            shutil.copy(folder / name, place / name)
        for module in folder.glob("src/*/__init__.py"):
            made = place / "src" / module.parent.name
            made.mkdir(parents=True)
            shutil.copy(module, made / "__init__.py")
            (made / "py.typed").touch()
    shutil.copy(distributions.ROOT / "CHANGELOG.md", tmp_path)
    return tmp_path


def edit(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))


def test_the_distributions_of_this_repository_agree() -> None:
    assert list(distributions.faults()) == []


@pytest.mark.parametrize(
    ("place", "spoil"),
    [
        (VIEW, lambda root: edit(root / VIEW / FILE, '"0.5.0"', '"0.5.1"')),
        (VIEW, lambda root: edit(root / VIEW / FILE, ">=0.5.0,<0.6", ">=0.4,<0.6")),
        (VIEW, lambda root: edit(root / VIEW / FILE, ">=0.5.0,<0.6", ">=0.5.0,<0.7")),
        (VIEW, lambda root: (root / VIEW / "LICENSE").unlink()),
        (VIEW, lambda root: (root / VIEW / "src/rn_view/py.typed").unlink()),
        ("__version__", lambda root: edit(root / CORE / FILE, '"0.5.0"', '"0.5.1"')),
        (
            "urls",
            lambda root: edit(root / CORE / FILE, "[tool", '[project.urls]\nA = "a:b"\n[tool'),
        ),
    ],
    ids=["version", "floor", "cap", "licence", "typed", "module", "address"],
)
def test_what_differs_is_named(copy: Path, place: str, spoil: Callable[[Path], object]) -> None:
    distributions.set_version("0.5.0", copy)
    spoil(copy)
    assert any(place in fault for fault in distributions.faults(copy))


def test_a_version_is_set_everywhere_with_the_ranges(copy: Path) -> None:
    distributions.set_version("0.3.1", copy)
    assert list(distributions.faults(copy)) == []
    assert {distributions.facts_of(one)["version"] for one in distributions.projects(copy)} == {
        "0.3.1"
    }
    assert "roboneuron-core>=0.3.1,<0.4" in distributions.facts_of(copy)["dependencies"]


def test_an_address_is_set_everywhere_and_again(copy: Path) -> None:
    for address in ("https://example.org/one", "https://example.org/two"):
        distributions.set_url(address, copy)
        assert list(distributions.faults(copy)) == []
        for folder in distributions.projects(copy):
            assert distributions.facts_of(folder)["urls"]["Issues"] == f"{address}/issues"
            tables = tomllib.loads((folder / "pyproject.toml").read_text())
            assert "wheel" in tables["tool"]["hatch"]["build"]["targets"]


def test_old_names_end_with_a_later_release() -> None:
    """Before a minor release remove the old names that end with it, then raise OLD_NAMES_END."""
    version = distributions.version_of()
    assert distributions.next_minor(version) == OLD_NAMES_END


def test_a_tag_needs_its_version_a_heading_and_an_address(copy: Path) -> None:
    version = distributions.version_of(copy)
    (copy / "CHANGELOG.md").write_text("# Changes\n")
    assert len(list(distributions.faults_of_tag("v9.9.9", copy))) == 3
    distributions.set_url("https://example.org/project", copy)
    (copy / "CHANGELOG.md").write_text(f"# Changes\n\n## {version} (2026-11-30)\n")
    assert list(distributions.faults_of_tag(f"v{version}", copy)) == []
