"""Plugins only import public names of the core, and published ones of each other."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import ModuleType

import pytest
from import_facts import CORE, PLUGINS, STANDARD, imports_of

from rn_testing.distribution import LISTS, imported_modules
from rn_testing.rules.package_imports import KIT, is_public, lists_for, published

PROGRAMS = ("lerobot_robot_roboneuron", "lerobot_teleoperator_roboneuron")
"""Packages that run in a program started by a person, like commands: they join the graph
themselves, and their messages pass control's limits and stops.
"""
COMMANDS_APART = {"doctor": "ops"}
"""Packages of rn_standard without a plugin module, by the plugin that uses them or brings their
command or offers.
"""
NEEDS = {
    "demo": {"console"},
    "doctor": {"ops"},
    "simulate": {"tasks"},
    "tasks": {"teleoperation"},
}
"""Packages of rn_standard by the other ones that they may import."""
PUBLISHED = {
    "console": "chosen_plugins client diagnostics plugin_options status",
    "declared_arm": "arm_draft real_drivers urdf_guesses urdf_home urdf_joints urdf_limits "
    "urdf_tree",
    "http": "addresses authentication bounded_server connections feature listener operator_lease "
    "options origins plugin tokens",
    "ops": "maintenance",
    "tasks": "contract_cases guarded history hooks judging monitor moving named_targets "
    "pictures run_task runner snapshot task_robot task_time",
    "teleoperation": "contract_cases feature hooks rows samples",
}
"""Modules of these packages that others may import."""


def _plugins() -> Iterator[tuple[str, tuple[Path, ...]]]:
    """Each plugin or library by name, with its packages: all of a distribution; in rn-standard each
    separately.
    """
    for sources in sorted(PLUGINS.glob("*/src")):
        if sources != STANDARD.parent:
            yield (
                sources.parent.name,
                tuple(sorted(path.parent for path in sources.glob("*/__init__.py"))),
            )
    for package in sorted(path.parent for path in STANDARD.glob("*/__init__.py")):
        if package.name not in COMMANDS_APART:
            apart = [
                STANDARD / name for name, owner in COMMANDS_APART.items() if owner == package.name
            ]
            yield f"rn-standard/{package.name}", (package, *apart)


def _offers(packages: Iterable[Path]) -> str:
    """Text of the plugin modules; a library has none."""
    modules = [package / "plugin.py" for package in packages]
    return "".join(path.read_text(encoding="utf-8") for path in modules if path.exists())


def _private_imports(packages: Iterable[Path]) -> Iterator[str]:
    """Names that a plugin imports from the core outside `roboneuron` and the lists for its
    offers.
    """
    packages = tuple(packages)
    offers = _offers(packages)
    lists = lists_for(
        features="FeatureSpec" in offers,
        commands="CommandSpec" in offers or {path.name for path in packages} <= {*PROGRAMS},
        is_kit=PLUGINS / KIT in next(iter(packages)).parents,
    )
    for path in sorted(path for package in packages for path in package.rglob("*.py")):
        for name, line in imported_modules(path):
            if not is_public(name, lists):
                yield f"{path.relative_to(PLUGINS)}:{line} imports {name}"


def test_plugins_import_only_what_is_public_of_the_core():
    assert [breach for _, packages in _plugins() for breach in _private_imports(packages)] == []


MOST_NAMES = {"roboneuron.feature": 65, "roboneuron.command": 32}
"""Maximum numbers for features and commands, and for commands alone; they only decrease."""
MOST_PUBLISHED = 56
"""Maximum number of names in the `__all__` of modules of the core; it only decreases."""


def _offered(of: str) -> set[str]:
    """Single names, and each name of a module, because a module counts as all its usable names."""
    groups = LISTS[of].GROUPS
    return (set(LISTS[of].__all__) - groups.keys()) | {
        f"{group}.{name}" for group, names in groups.items() for name in names
    }


def test_every_listed_name_is_used_by_a_plugin_and_they_stay_few():
    imported = {
        name for path in PLUGINS.glob("*/src/**/*.py") for name, _ in imported_modules(path)
    }
    for of in LISTS:
        used = {name.removeprefix(f"{of}.") for name in imported if name.startswith(f"{of}.")}
        assert used - LISTS[of].GROUPS.keys() == _offered(of)
        assert len(_offered(of)) <= MOST_NAMES[of]


def test_every_published_name_is_used_and_they_stay_few():
    """Packages and the lists have a computed `__all__`, or one that their own tests judge."""
    offered = {
        f"{module}.{name}"
        for path in CORE.rglob("*.py")
        if path.name != "__init__.py"
        for module in [".".join(path.relative_to(CORE.parent).with_suffix("").parts)]
        for name in published(module)
    }
    imported = {
        name for path in PLUGINS.glob("*/src/**/*.py") for name, _ in imported_modules(path)
    }
    whole = {module for module in imported if published(module)}
    assert {n for n in offered if n not in imported and n.rpartition(".")[0] not in whole} == set()
    assert len(offered) <= MOST_PUBLISHED


@pytest.mark.parametrize("of", LISTS)
def test_every_name_of_a_listed_module_is_there(of):
    listed = LISTS[of]
    assert listed.GROUPS.keys() == {
        name for name in listed.__all__ if isinstance(getattr(listed, name), ModuleType)
    }
    for group, names in listed.GROUPS.items():
        assert {n for n in names if not hasattr(getattr(listed, group), n)} == set()


@pytest.mark.parametrize(
    ("offers", "line", "is_seen"),
    [
        ("BackendSpec", "from roboneuron import Frame", False),
        ("BackendSpec", "from roboneuron.contract import Frame", True),
        ("BackendSpec", "from roboneuron.feature import Config", True),
        ("FeatureSpec", "from roboneuron.feature import Config", False),
        ("FeatureSpec", "from roboneuron.feature import RosLink", True),
        ("FeatureSpec", "from roboneuron.feature import Supervisor", True),
        ("FeatureSpec", "from roboneuron.feature import topics\ntopics.PREDICTIONS", False),
        ("FeatureSpec", "from roboneuron.feature import topics as t\nt.anything", True),
        ("FeatureSpec", "from roboneuron.command import RosLink", True),
        ("FeatureSpec", "from roboneuron.feature import ModuleHost", False),
        ("CommandSpec", "from roboneuron.command import RosLink", False),
        ("CommandSpec", "from roboneuron.feature import Config", False),
        ("CommandSpec", "from roboneuron.command import Config", True),
        ("FeatureSpec", "from roboneuron.config import Config", True),
        ("CommandSpec", "import roboneuron.server.app", True),
    ],
)
def test_an_import_of_what_is_private_is_seen(tmp_path, monkeypatch, offers, line, is_seen):
    monkeypatch.setattr(sys.modules[__name__], "PLUGINS", tmp_path)
    (tmp_path / "plugin.py").write_text(f"from roboneuron import {offers}\n")
    (tmp_path / "bad.py").write_text(f"{line}\n")
    assert bool(list(_private_imports([tmp_path]))) is is_seen


def _breaches_among_features(path: Path) -> Iterator[str]:
    """Forbidden imports of a file from another package of rn_standard."""
    inside = path.relative_to(PLUGINS).parts
    own = inside[3] if path.is_relative_to(STANDARD) else ""
    for name, line in imports_of(path):
        top, package, module, *_ = [*name.split("."), "", ""]
        if top != "rn_standard" or package == own:
            continue
        if own and package not in NEEDS.get(own, ()):
            yield (
                f"{path.relative_to(PLUGINS)}:{line} imports {name}: {own} does not need {package}"
            )
        elif module not in PUBLISHED.get(package, "").split():
            yield (
                f"{path.relative_to(PLUGINS)}:{line} imports {name}, which {package} does not "
                "publish"
            )


def test_features_import_of_each_other_only_what_is_published():
    breaches = [
        breach
        for path in sorted(PLUGINS.glob("*/src/**/*.py"))
        for breach in _breaches_among_features(path)
    ]
    assert breaches == []


def test_a_feature_that_reaches_into_another_is_seen(tmp_path, monkeypatch):
    monkeypatch.setattr(sys.modules[__name__], "PLUGINS", tmp_path)
    monkeypatch.setattr(
        sys.modules[__name__], "STANDARD", tmp_path / "rn-standard" / "src" / "rn_standard"
    )
    bad = tmp_path / "rn-standard" / "src" / "rn_standard" / "tasks" / "bad.py"
    bad.parent.mkdir(parents=True)
    bad.write_text(
        "from rn_standard.teleoperation.rows import x\n"  # allowed
        "from rn_standard.teleoperation.lead import x\nfrom rn_standard.ops.restarts import x\n"
        "import rn_standard.http\n"
    )
    elsewhere = tmp_path / "rn-eval" / "src" / "rn_eval" / "bad.py"
    elsewhere.parent.mkdir(parents=True)
    elsewhere.write_text(
        "from rn_standard.tasks.judging import x\nfrom rn_standard.tasks.live import x\n"
    )
    assert len(list(_breaches_among_features(bad))) == 3
    assert len(list(_breaches_among_features(elsewhere))) == 1


def test_the_tables_name_packages_and_modules_that_are_there():
    named = {
        *NEEDS,
        *PUBLISHED,
        *COMMANDS_APART,
        *(name for needed in NEEDS.values() for name in needed),
    }
    assert {name for name in named if not (STANDARD / name / "__init__.py").exists()} == set()
    modules = [
        STANDARD / package / name for package, names in PUBLISHED.items() for name in names.split()
    ]
    assert [
        m for m in modules if not (m.with_suffix(".py").exists() or (m / "__init__.py").exists())
    ] == []


def test_plugins_import_the_contract_kit_only_where_their_descriptors_name_a_case():
    breaches = []
    for plugin in sorted(
        set(PLUGINS.glob("*/src/**/plugin.py")) - set(PLUGINS.glob("rn-testing/src/*/plugin.py"))
    ):
        sources = sorted(plugin.parent.rglob("*.py"))
        root = next(path for path in plugin.parents if path.name == "src")
        importing = {
            p
            for p in sources
            if any(name.split(".")[0] == "rn_testing" for name, _ in imports_of(p))
        }
        hooks = plugin.with_name("hooks.py")  # another kind names its rules there
        named = "".join(p.read_text(encoding="utf-8") for p in (plugin, hooks) if p.exists())
        breaches += [
            f"{path.relative_to(PLUGINS)} imports rn_testing and is no `case`"
            for path in importing
            if f'"{".".join(path.relative_to(root).with_suffix("").parts)}:' not in named
        ]
    assert breaches == []
