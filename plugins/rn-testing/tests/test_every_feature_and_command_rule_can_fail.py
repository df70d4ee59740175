"""Each rule of features and commands is broken by some plugin, and kept by the good one."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from rn_testing import Case, CommandCase, FeatureCase, RuleVerdict, verify
from rn_testing.rules import RULES
from roboneuron import CommandSpec, FeatureSpec

FEATURE = FeatureSpec(
    name="wheels",
    summary="Counts wheels.",
    target="broken_features:Good",
    config="broken_features:Options",
)
COMMAND = CommandSpec(name="greet", summary="greet somebody", target="broken_features:GoodCommand")
GOOD: dict[str, Case[Any]] = {
    "feature": FeatureCase(spec=FEATURE, limits_s={"start": 2.0}),
    "command": CommandCase(spec=COMMAND),
}
BROKEN = [
    ("feature", "feature/class", {"target": "broken_features:NoFeature"}),
    ("feature", "feature/constructor-pure", {"target": "broken_features:OpensFile"}),
    ("feature", "feature/defaults", {"config": "broken_features:Needy"}),
    ("feature", "feature/loads", {"target": "broken_features:Raises"}),
    ("feature", "feature/loads", {"target": "broken_features:ClashingName"}),
    ("feature", "feature/tools-described", {"target": "broken_features:CamelCase"}),
    ("feature", "feature/tools-described", {"target": "broken_features:SaysNothing"}),
    ("feature", "feature/closes", {"target": "broken_features:LeavesThread"}),
    ("feature", "feature/closes", {"target": "broken_features:CloseNeedsStart"}),
    ("feature", "feature/closes", {"target": "broken_features:StartsForEver"}),
    ("feature", "feature/process-left-alone", {"target": "broken_features:Prints"}),
    ("feature", "feature/process-left-alone", {"target": "broken_features:TakesSignals"}),
    ("feature", "feature/no-way-round-the-gate", {"target": "rn_gateless:Gateless"}),
    ("feature", "feature/no-way-round-the-gate", {"target": "rn_borrowed_writer:Borrower"}),
    ("command", "command/protocol", {"target": "broken_features:NoRun"}),
    ("command", "command/constructor-pure", {"target": "broken_features:RunsAProcess"}),
    ("command", "command/configure-pure", {"target": "broken_features:ReadsForHelp"}),
    ("command", "command/configure-pure", {"target": "broken_features:PrintsForHelp"}),
    ("command", "command/help", {"target": "broken_features:NoHelp"}),
    ("command", "command/light", {"target": "broken_heavy_command:Heavy"}),
]


@pytest.fixture(autouse=True)
def _visible_to_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    import os
    from pathlib import Path

    monkeypatch.setenv(
        "PYTHONPATH", f"{Path(__file__).parent / 'mutants'}:{os.environ.get('PYTHONPATH', '')}"
    )


@pytest.mark.sampled(every=5)
@pytest.mark.parametrize(
    ("kind", "rule_id", "changes"),
    BROKEN,
    ids=lambda v: v if isinstance(v, str) else "".join(v.values()),
)
def test_a_broken_plugin_fails_its_rule_and_the_good_one_passes(
    kind: str, rule_id: str, changes: Any
) -> None:
    rule = next(rule for rule in RULES[kind] if rule.id == rule_id)
    assert verify(rule, GOOD[kind]).verdict is RuleVerdict.PASSED
    case = replace(GOOD[kind], spec=replace(GOOD[kind].spec, **changes))
    outcome = verify(rule, case)
    assert outcome.verdict is RuleVerdict.FAILED, outcome
    assert outcome.detail


def test_every_rule_has_a_plugin_that_breaks_it() -> None:
    own = {
        rule.id for kind in GOOD for rule in RULES[kind] if not rule.id.startswith("descriptor/")
    }
    assert own == {rule_id for _, rule_id, _ in BROKEN}
