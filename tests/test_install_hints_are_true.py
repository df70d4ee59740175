"""Packages are on no index: hints and pages name installable things as written; the table of
packages is correct.
"""

from __future__ import annotations

import os
import re
import runpy
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from roboneuron.errors import ConfigurationError
from roboneuron.plugins.availability import install_command, known_names, package_of
from roboneuron.plugins.discovery import discover
from roboneuron.plugins.registry import Registry, Status
from roboneuron.plugins.specs import BackendSpec, FeatureSpec

ROOT = Path(__file__).parents[1]
closure = runpy.run_path(str(ROOT / "tools" / "requirements.py"))["closure"]
PROJECTS = sorted(ROOT.glob("plugins/rn-*/pyproject.toml"))
"""Plugins that RoboNeuron discovers; lerobot's plugin is discovered and installed with lerobot."""
COMMON = {
    "roboneuron",
    *closure(tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]),
}
"""Packages of requirements.txt."""


def needs(path: Path) -> set[str]:
    """The project's own plugins that a package requires."""
    names = re.findall(
        r'"(rn-[a-z0-9-]+)',
        str(tomllib.loads(path.read_text())["project"]["dependencies"]).replace("'", '"'),
    )
    return {name for name in names if name != path.parent.name}


MOST_PATHS = 4
"""Maximum number of package folders in one hint or on one page."""


def test_every_offer_of_the_project_is_in_the_table() -> None:
    own = {path.parent.name for path in PROJECTS}
    registry = discover()
    for offer in registry.all_offers:
        if offer.distribution in own:
            package = package_of(offer.spec.kind, offer.spec.name)
            assert package is not None, (
                f"{offer.spec.kind} {offer.spec.name} is not in data/packages.toml"
            )
            assert package.partition("[")[0] == offer.distribution


def test_the_table_names_nothing_else() -> None:
    table = tomllib.loads((ROOT / "roboneuron-core/src/roboneuron/data/packages.toml").read_text())
    offered = {(o.spec.kind, o.spec.name) for o in discover().all_offers}
    kinds = {
        kind: names for kind, names in table.items() if kind not in ("needs", "switch", "renamed")
    }
    assert {(kind, name) for kind, names in kinds.items() for name in names} <= offered
    extras = {
        p.parent.name: tomllib.loads(p.read_text())["project"].get("optional-dependencies", {})
        for p in PROJECTS
    }
    for package in {package for kind, names in kinds.items() for package in names.values()}:
        name, _, extra = package.rstrip("]").partition("[")
        assert not extra or extra in extras[name]


def test_the_table_knows_which_features_the_command_line_switches_on() -> None:
    specs = [offer.spec for offer in discover().offers("feature")]
    switched = {
        s.name: package_of("feature", s.name)
        for s in specs
        if isinstance(s, FeatureSpec) and s.switch
    }
    assert known_names("switch") == switched


def test_the_table_knows_what_each_package_needs() -> None:
    direct = {path.parent.name: needs(path) for path in PROJECTS}
    direct["roboneuron"] = needs(ROOT / "pyproject.toml")

    def all_needs(name: str) -> set[str]:
        return direct[name].union(*(all_needs(other) for other in direct[name]))

    for name in direct:
        command = install_command(name)
        listed = re.findall(r"\./plugins/([a-z0-9-]+)", command)
        assert set(listed) == {name, *all_needs(name)} - COMMON
        assert ("-r requirements.txt" in command) == bool({name, *all_needs(name)} & COMMON)
        assert len(listed) <= MOST_PATHS


@pytest.mark.parametrize(
    ("name", "words"),
    [
        (
            "openvla",
            r"brings it\. Run: pip install (\./plugins/rn-(backend-openvla|runtime-torch|vla) "
            r"){3}\(in",
        ),
        (
            "pi0",
            r'rn-backend-pi0 brings it\. Run: pip install "\./plugins/rn-backend-pi0\[native\]"',
        ),
    ],
)
def test_what_is_not_installed_is_named_with_its_package(name: str, words: str) -> None:
    with pytest.raises(ConfigurationError, match=words):
        Registry(plugins=(), all_offers=()).get(BackendSpec, name)


def test_a_name_that_was_another_before_is_answered_with_the_new_one() -> None:
    registry = discover()
    with pytest.raises(ConfigurationError, match="'pi0-remote' is called 'openpi' now") as caught:
        registry.get(BackendSpec, "pi0-remote")
    assert "[plugins.openpi]" in caught.value.hint
    with pytest.raises(ConfigurationError, match=r"plugins\.pi0-remote.*called 'openpi' now"):
        registry.check_name("plugins.pi0-remote", "pi0-remote")
    table = tomllib.loads((ROOT / "roboneuron-core/src/roboneuron/data/packages.toml").read_text())
    assert table["renamed"].keys().isdisjoint(known_names())
    assert set(table["renamed"].values()) <= known_names().keys()


def installs() -> list[tuple[str, str]]:
    listed = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.split("\n")
    pages = [
        name
        for name in listed
        if name.endswith((".md", ".py", ".tmpl", ".toml")) and "/tests/" not in f"/{name}"
    ]
    found = []
    for page in pages:
        for line in re.findall(r"pip install[^\n;]*", (ROOT / page).read_text(encoding="utf-8")):
            found.append((page, line))
    return found


INSTALLED = """
from roboneuron import Requirement, install_command
from roboneuron.plugins.availability import explain
own = Requirement(module="absent_a", install="pip install './plugins/rn-recorder[export]'")
other = Requirement(module="absent_b", install="pip install mujoco")
print(install_command(), install_command("rn-eval"), explain([own, other]), sep="\\n")
"""
FOLDER, WHEELS, ANYWHERE = "./plugins/rn-eval", "--find-links", "WHEELS"


@pytest.mark.parametrize(
    ("origin", "expected"),
    [
        ('{"url": "file:///src/roboneuron-core", "dir_info": {"editable": true}}', FOLDER),
        ('{"url": "file:///src/roboneuron-core", "dir_info": {}}', FOLDER),
        (
            '{"url": "file://HERE/roboneuron_core-0.1.0-py3-none-any.whl", "archive_info": {}}',
            WHEELS,
        ),
        ('{"url": "file:///gone/roboneuron_core-0.1.0-py3-none-any.whl"}', ANYWHERE),
        ("", ANYWHERE),
    ],
    ids=["editable", "folder", "wheel", "wheel that is gone", "found by pip"],
)
def test_commands_fit_the_way_of_this_installation(
    origin: str, expected: str, tmp_path: Path
) -> None:
    about = tmp_path / "site" / "roboneuron_core-0.1.0.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: roboneuron-core\nVersion: 0.1.0\n"
    )
    if origin:
        (about / "direct_url.json").write_text(origin.replace("HERE", str(tmp_path)))
    done = subprocess.run(
        [sys.executable, "-c", INSTALLED],
        env={**os.environ, "PYTHONPATH": str(about.parent)},
        capture_output=True,
        text=True,
        check=True,
    )
    whole, one, absent = done.stdout.splitlines()
    assert expected in one
    assert "rn-recorder[export]" in absent
    assert absent.endswith("; pip install mujoco")
    for command in (whole, one, absent):
        assert ("source folder" in command or "./plugins" in command) is (expected == FOLDER)
        assert (WHEELS in command) is (expected != FOLDER)
        assert (str(tmp_path) in command) is (expected == WHEELS)


def test_no_hint_takes_a_package_of_the_project_from_an_index() -> None:
    lines = installs()
    assert len(lines) > 20
    for page, whole in lines:
        line = re.sub(r"\./rn-[a-z]+-my-\S+", "", whole)  # a package that the reader has made
        words = re.split(r"[#`]", line)[0]
        bare = re.findall(r"(?<![\w./-])(?:rn-[a-z0-9-]+|roboneuron-core)", words)
        assert not bare, f"{page}: {line}"
        for folder in re.findall(r"\./((?:plugins/)?(?:rn-[a-z0-9-]+|roboneuron-core))", line):
            assert (ROOT / folder / "pyproject.toml").exists(), f"{page}: {line}"


def test_no_page_lists_many_folders() -> None:
    folders: dict[str, set[str]] = {}
    for page in {page for page, _ in installs() if page != "CHANGELOG.md"}:
        text = (ROOT / page).read_text(encoding="utf-8").replace("\\\n", " ")
        for line in re.findall(r"pip install[^\n;]*", text):
            folders.setdefault(page, set()).update(
                re.findall(r"\./(?:plugins/)?(rn-[a-z0-9-]+|roboneuron-core)", line)
            )
    assert "README.md" in folders
    assert {page: sorted(found) for page, found in folders.items() if len(found) > MOST_PATHS} == {}


def test_requirements_files_are_what_the_tool_writes() -> None:
    tool = runpy.run_path(str(ROOT / "tools" / "requirements.py"))
    made = tool["texts"]()
    assert {"requirements.txt", "requirements-vla.txt"} <= made.keys()
    for name, text in made.items():
        assert (ROOT / name).read_text(encoding="utf-8") == text, (
            "run: python tools/requirements.py"
        )


def test_requirements_hold_every_package_that_is_needed() -> None:
    lines = (ROOT / "requirements.txt").read_text(encoding="utf-8").splitlines()
    listed = {Path(line).name for line in lines if line.startswith("./")}
    assert {"roboneuron-core", "rn-standard", "rn-robot-fr3", "rn-simulation", "rn-view"} <= listed
    unmet = {
        need for path in PROJECTS if path.parent.name in listed for need in needs(path)
    } - listed
    assert unmet == set()
    assert all((ROOT / line / "pyproject.toml").exists() for line in lines if line.startswith("./"))


def test_the_root_is_the_whole_and_a_workspace_of_all_packages() -> None:
    facts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert facts["project"]["name"] == "roboneuron"
    names = {"roboneuron-core", *(path.parent.name for path in PROJECTS)}
    assert set(facts["tool"]["uv"]["sources"]) == names
    assert facts["tool"]["uv"]["workspace"]["members"] == ["roboneuron-core", "plugins/*"]


def test_requirements_of_ready_offers_name_modules_that_exist() -> None:
    ready = [o for o in discover().all_offers if o.status is Status.READY]
    assert ready
    assert all(r.install.startswith("pip install ") for o in ready for r in o.spec.requires)


@pytest.mark.parametrize(
    "page", [*PROJECTS, ROOT / "roboneuron-core" / "pyproject.toml"], ids=lambda p: p.parent.name
)
def test_readmes_of_packages_have_no_relative_links(page: Path) -> None:
    text = (page.parent / "README.md").read_text(encoding="utf-8")
    assert re.findall(r"\]\((?!https://|#)[^)]*\)", text) == []
