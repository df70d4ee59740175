"""Several plugins of one distribution are examined separately: files, descriptors, imports."""

from __future__ import annotations

from pathlib import Path

import pytest

from rn_testing import PackageCase, RuleVerdict, verify
from rn_testing.distribution import find_entry_points, plugin_package, source_files
from rn_testing.rules import RULES

PLUGIN = """
from roboneuron import BackendSpec, hookimpl

{line}

@hookimpl
def roboneuron_backends():
    return [BackendSpec(name="{name}", summary="A sample.", target="rn_pair.{name}.policy:Policy")]
"""
RULE = {rule.id.removeprefix("package/"): rule for rule in RULES["package"]}


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """A distribution of two plugins, the second with a package inside that of a third."""
    info = tmp_path / "rn_pair-1.0.dist-info"
    info.mkdir()
    points = {
        "rn-left": "rn_pair.left.plugin",
        "rn-right": "rn_pair.right.plugin",
        "rn-in": "rn_pair.right.inner.plugin",
    }
    lines = [f"{name} = {module}" for name, module in points.items()]
    (info / "entry_points.txt").write_text("\n".join(["[roboneuron]", *lines]) + "\n")
    (info / "METADATA").write_text("Metadata-Version: 2.4\nName: rn-pair\nVersion: 1.0\n")
    package = tmp_path / "rn_pair"
    for folder in (package, package / "left", package / "right", package / "right" / "inner"):
        folder.mkdir()
        (folder / "__init__.py").touch()
    (package / "py.typed").touch()
    for name in ("left", "right"):
        (package / name / "plugin.py").write_text(PLUGIN.format(name=name, line=""))
        (package / name / "policy.py").write_text("from roboneuron import Observation\n")
    (package / "right" / "inner" / "plugin.py").write_text(PLUGIN.format(name="inner", line=""))
    return tmp_path


def case(site: Path, plugin: str) -> PackageCase:
    return PackageCase(distribution="rn-pair", plugin=plugin, path=(str(site),))


def files(site: Path, plugin: str) -> set[str]:
    return {
        str(p.relative_to(site / "rn_pair").parent / p.stem)
        for p in source_files(case(site, plugin))
    }


def test_the_files_are_those_of_the_plugin(site):
    assert files(site, "rn-left") == {"left/__init__", "left/plugin", "left/policy"}
    assert files(site, "rn-right") == {"right/__init__", "right/plugin", "right/policy"}
    assert files(site, "rn-in") == {"right/inner/__init__", "right/inner/plugin"}
    assert files(site, "") > files(site, "rn-left") | files(site, "rn-right") | files(site, "rn-in")


def test_a_fault_of_one_is_none_of_the_other(site):
    (site / "rn_pair" / "left" / "policy.py").write_text("from roboneuron.server import app\n")
    direction = RULE["import-direction"]
    assert verify(direction, case(site, "rn-left")).verdict is RuleVerdict.FAILED
    assert verify(direction, case(site, "rn-right")).verdict is RuleVerdict.PASSED


def test_a_plugin_module_that_loads_the_one_beside_it_is_not_light(site):
    light = RULE["plugin-module-light"]
    assert verify(light, case(site, "rn-right")).verdict is RuleVerdict.PASSED
    other = PLUGIN.format(name="left", line="import rn_pair.right")
    (site / "rn_pair" / "left" / "plugin.py").write_text(other)
    outcome = verify(light, case(site, "rn-left"))
    assert outcome.verdict is RuleVerdict.FAILED
    assert "imports rn_pair.right" in outcome.detail


def test_a_plugin_that_the_distribution_lacks_is_named(site):
    assert [p.name for p in find_entry_points(case(site, "rn-left"))] == ["rn-left"]
    outcome = verify(RULE["entry-point"], case(site, "rn-middle"))
    assert "rn-pair has no entry point 'rn-middle'" in outcome.detail


def test_a_module_belongs_to_the_nearest_plugin():
    assert plugin_package("rn_standard.tasks.feature") == "rn_standard.tasks"
    assert plugin_package("roboneuron.tools.arm.limits_command") == "roboneuron.tools.arm"
    assert plugin_package("rn_standard.doctor.checks") == "rn_standard"
    assert plugin_package("rn_eval.libero.suite") == "rn_eval.libero"
    assert plugin_package("rn_eval.cubes") == "rn_eval"
    assert plugin_package("rn_view.feature") == "rn_view"
    assert plugin_package("somebody_else.feature") == "somebody_else"


@pytest.mark.parametrize("name", ["rn-standard", "rn-tasks"])
def test_a_distribution_is_checked_plugin_by_plugin(name):
    from rn_standard.console.chosen_plugins import find
    from roboneuron.plugins.discovery import discover

    found = [record for record, _ in find(discover(), name)]
    assert {record.distribution for record in found} == {"rn-standard"}
    assert "rn-tasks" in {record.name for record in found}
    assert (len(found) > 1) == (name == "rn-standard")
