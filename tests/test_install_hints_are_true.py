"""Packages are on no index: hints and pages name what can be installed as written; the table of packages is true."""

from __future__ import annotations

import re
import subprocess
import tomllib
from pathlib import Path

import pytest

from roboneuron.errors import ConfigurationError
from roboneuron.plugins.availability import install_command, package_of
from roboneuron.plugins.discovery import discover
from roboneuron.plugins.registry import Registry, Status

ROOT = Path(__file__).parents[1]
PROJECTS = sorted(ROOT.glob("plugins/*/pyproject.toml"))


def needs(path: Path) -> set[str]:
    """The project's own plugins that one depends on."""
    names = re.findall(
        r'"(rn-[a-z0-9-]+)', str(tomllib.loads(path.read_text())["project"]["dependencies"]).replace("'", '"')
    )
    return {name for name in names if name != path.parent.name}


def test_every_offer_of_the_project_is_in_the_table() -> None:
    own = {path.parent.name for path in PROJECTS}
    registry = discover()
    for offer in registry.all_offers:
        if offer.distribution in own:
            package = package_of(offer.spec.kind, offer.spec.name)
            assert package is not None, f"{offer.spec.kind} {offer.spec.name} is not in data/packages.toml"
            assert package.partition("[")[0] == offer.distribution


def test_the_table_names_nothing_else() -> None:
    table = tomllib.loads((ROOT / "roboneuron-core/src/roboneuron/data/packages.toml").read_text())
    offered = {(o.spec.kind, o.spec.name) for o in discover().all_offers}
    assert {(kind, name) for kind, names in table.items() if kind != "needs" for name in names} <= offered
    extras = {p.parent.name: tomllib.loads(p.read_text())["project"].get("optional-dependencies", {}) for p in PROJECTS}
    for package in {package for kind, names in table.items() if kind != "needs" for package in names.values()}:
        name, _, extra = package.rstrip("]").partition("[")
        assert not extra or extra in extras[name]


def test_the_table_knows_what_each_package_needs() -> None:
    direct = {path.parent.name: needs(path) for path in PROJECTS}

    def all_needs(name: str) -> set[str]:
        return direct[name].union(*(all_needs(other) for other in direct[name]))

    for name in direct:
        assert set(re.findall(r"\./plugins/([a-z0-9-]+)", install_command(name))) == {name, *all_needs(name)}


@pytest.mark.parametrize(
    ("kind", "name", "words"),
    [
        (
            "backend",
            "openvla",
            r"brings it\. Run: pip install (\./plugins/rn-(backend-openvla|runtime-torch|vla) ){3}\(in",
        ),
        ("backend", "pi0-remote", r'rn-backend-pi0 brings it\. Run: pip install "\./plugins/rn-backend-pi0\[remote\]"'),
    ],
)
def test_what_is_not_installed_is_named_with_its_package(kind: str, name: str, words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        Registry(plugins=(), all_offers=()).get(kind, name)


def installs() -> list[tuple[str, str]]:
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split(
        "\n"
    )
    pages = [name for name in listed if name.endswith((".md", ".py", ".tmpl", ".toml")) and "/tests/" not in f"/{name}"]
    found = []
    for page in pages:
        for line in re.findall(r"pip install[^\n;]*", (ROOT / page).read_text(encoding="utf-8")):
            found.append((page, line))
    return found


def test_no_hint_takes_a_package_of_the_project_from_an_index() -> None:
    lines = installs()
    assert len(lines) > 20
    for page, line in lines:
        bare = re.findall(r"(?<![\w./-])(?:rn-[a-z0-9]+-[a-z0-9]+|roboneuron-core)", line.partition("#")[0])
        assert not bare, f"{page}: {line}"
        for folder in re.findall(r"\./((?:plugins/)?(?:rn-[a-z0-9-]+|roboneuron-core))", line):
            assert (ROOT / folder / "pyproject.toml").exists(), f"{page}: {line}"


def test_requirements_of_ready_offers_name_modules_that_exist() -> None:
    ready = [o for o in discover().all_offers if o.status is Status.READY]
    assert ready
    assert all(r.install.startswith("pip install ") for o in ready for r in o.spec.requires)


@pytest.mark.parametrize("page", [*PROJECTS, ROOT / "roboneuron-core" / "pyproject.toml"], ids=lambda p: p.parent.name)
def test_readmes_of_packages_have_no_relative_links(page: Path) -> None:
    text = (page.parent / "README.md").read_text(encoding="utf-8")
    assert re.findall(r"\]\((?!https://|#)[^)]*\)", text) == []
