"""Every installed plugin has its own contract tests, and passes the check that users run."""

from __future__ import annotations

import ast
from collections import Counter
from importlib.metadata import distribution
from pathlib import Path
from typing import Any

import pytest

from rn_testing import Rule, RuleVerdict, verify
from rn_testing.automatic import make_case
from rn_testing.rules import rules_of
from roboneuron.plugins.discovery import discover
from roboneuron.plugins.registry import PluginRecord, Status
from roboneuron.plugins.specs import Spec

REGISTRY = discover()
PLUGINS = Path(__file__).parents[1] / "plugins"
CORE = "roboneuron-core"
GENERIC = {"feature", "command"}
OFFERS = [offer.spec for offer in REGISTRY.all_offers if offer.status is Status.READY]


@pytest.mark.parametrize("plugin", REGISTRY.plugins, ids=lambda plugin: plugin.name)
def test_every_installed_plugin_can_be_used_or_says_what_to_install(plugin: PluginRecord):
    assert plugin.status in (Status.READY, Status.UNAVAILABLE), plugin.reason + plugin.traceback


def folder_of_tests(plugin: PluginRecord) -> Path:
    """Folder of a plugin's tests: those of `rn_standard.tasks.plugin` are in `tests/tasks`."""
    where = PLUGINS.parent if plugin.distribution == CORE else PLUGINS
    return where.joinpath(plugin.distribution, "tests", *plugin.module.split(".")[1:-1])


def contract_classes(plugin: PluginRecord) -> list[str]:
    """Kind of each contract class in a plugin's tests; one with a parametrised fixture counts for
    all offers.
    """
    found: list[str] = []
    own = folder_of_tests(plugin)
    others = {folder_of_tests(other) for other in REGISTRY.plugins} - {own, *own.parents}
    for path in sorted(own.rglob("test_*.py")):
        if not others.isdisjoint(path.parents):
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            for base in node.bases if isinstance(node, ast.ClassDef) else ():
                text = (
                    ast.unparse(base)
                    .removeprefix("contract_of(")
                    .removesuffix("Spec)")
                    .removesuffix("Contract")
                )
                if text != ast.unparse(base):
                    found += [text.lower()] * (1000 if "params=" in ast.unparse(node) else 1)
    return found


@pytest.mark.parametrize("plugin", REGISTRY.plugins, ids=lambda plugin: plugin.name)
def test_every_installed_plugin_is_tried_by_contract_tests_of_its_own(plugin: PluginRecord):
    """The rules run there once, with the author's inputs; those of features and commands run in
    test_features_and_packages_keep_their_contracts.py.
    """
    offered = Counter(
        offer.spec.kind
        for offer in plugin.offers
        if (offer.spec.requires == () or offer.spec in OFFERS) and offer.spec.kind not in GENERIC
    )
    tried = Counter(contract_classes(plugin))
    counted = {kind: tried[kind.replace("-", "")] for kind in offered}
    assert not {kind: count for kind, count in offered.items() if counted[kind] < count}


# the rules again, as `roboneuron plugins check` runs them: with the shipped or an automatic case
@pytest.mark.slow
@pytest.mark.parametrize(
    ("spec", "rule"),
    [
        pytest.param(s, r, id=f"{s.kind} {s.name}:{r.id}")
        for s in OFFERS
        if s.kind not in GENERIC
        for r in rules_of(s.kind)
    ],
)
def test_every_installed_offer_keeps_the_rules_of_its_kind(spec: Spec, rule: Rule[Any]):
    outcome = verify(rule, make_case(spec, {}))
    if outcome.verdict is RuleVerdict.SKIPPED:
        pytest.skip(outcome.detail)
    assert outcome.verdict is RuleVerdict.PASSED, (
        f"{rule.text} {outcome.detail}\n{outcome.traceback}"
    )


@pytest.mark.parametrize(
    "plugin",
    [plugin for plugin in REGISTRY.plugins if plugin.distribution != CORE],
    ids=lambda plugin: plugin.name,
)
def test_every_installed_plugin_needs_this_version_of_the_core(plugin: PluginRecord):
    requirements = distribution(plugin.distribution).requires or []
    core = [
        r.replace(" ", "")
        for r in requirements
        if r.startswith("roboneuron-core") and "extra" not in r
    ]
    assert len(core) == 1
    assert ">=0.1" in core[0]
    assert "<0.2" in core[0]
