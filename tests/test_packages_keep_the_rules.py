"""Every installed plugin keeps the package rules and the rules of each thing it offers."""

from __future__ import annotations

import re
from importlib.metadata import distribution
from pathlib import Path
from typing import Any

import pytest

from rn_testing import PackageCase, Rule, Verdict, verify
from rn_testing.automatic import make_case
from rn_testing.rules import RULES, rules_of
from roboneuron.plugins.discovery import discover
from roboneuron.plugins.registry import PluginRecord, Status
from roboneuron.plugins.specs import Spec

REGISTRY = discover()
PLUGINS = Path(__file__).parents[1] / "plugins"
LONG = "/memory-bounded"
"""Takes seconds each: left to the contract tests of the packages."""
OFFERS = [offer.spec for offer in REGISTRY.all_offers if offer.status is Status.READY]


@pytest.mark.parametrize("plugin", REGISTRY.plugins, ids=lambda plugin: plugin.distribution)
def test_every_installed_plugin_can_be_used_or_says_what_to_install(plugin: PluginRecord):
    assert plugin.status in (Status.READY, Status.UNAVAILABLE), plugin.reason + plugin.traceback


@pytest.mark.parametrize("rule", RULES["package"], ids=lambda rule: rule.id)
@pytest.mark.parametrize("plugin", REGISTRY.plugins, ids=lambda plugin: plugin.distribution)
def test_every_installed_plugin_keeps_the_package_rules(plugin: PluginRecord, rule: Rule[PackageCase]):
    outcome = verify(rule, PackageCase(distribution=plugin.distribution))
    assert outcome.verdict is Verdict.PASSED, f"{rule.text} {outcome.detail}"


@pytest.mark.parametrize(
    ("spec", "rule"),
    [
        pytest.param(s, r, id=f"{s.kind} {s.name}:{r.id}")
        for s in OFFERS
        for r in rules_of(s.kind)
        if not r.id.endswith(LONG)
    ],
)
def test_every_installed_offer_keeps_the_rules_of_its_kind(spec: Spec, rule: Rule[Any]):
    outcome = verify(rule, make_case(spec, {}))
    if outcome.verdict is Verdict.SKIPPED:
        pytest.skip(outcome.detail)
    assert outcome.verdict is Verdict.PASSED, f"{rule.text} {outcome.detail}\n{outcome.traceback}"


@pytest.mark.parametrize("plugin", REGISTRY.plugins, ids=lambda plugin: plugin.distribution)
def test_every_installed_plugin_needs_this_version_of_the_core(plugin: PluginRecord):
    requirements = distribution(plugin.distribution).requires or []
    core = [r.replace(" ", "") for r in requirements if r.startswith("roboneuron-core") and "extra" not in r]
    assert len(core) == 1
    assert ">=0.1" in core[0]
    assert "<0.2" in core[0]


@pytest.mark.parametrize("spec", OFFERS, ids=lambda spec: f"{spec.kind} {spec.name}")
def test_what_has_long_rules_has_contract_tests_in_its_package(spec: Spec):
    if not any(rule.id.endswith(LONG) for rule in rules_of(spec.kind)):
        pytest.skip("no rule is long")
    (package,) = {offer.distribution for offer in REGISTRY.all_offers if offer.spec is spec}
    written = "".join(path.read_text() for path in (PLUGINS / package / "tests").glob("test_*.py"))
    assert re.search(rf"^class Test\w+\({spec.kind.capitalize()}Contract\)", written, re.MULTILINE)
