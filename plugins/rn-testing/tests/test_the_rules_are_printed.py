"""`roboneuron plugins rules` prints the contract rules of a kind."""

from __future__ import annotations

from argparse import Namespace

import pytest

from rn_testing.plugin_rules import PluginsRules
from rn_testing.rules import RULES
from roboneuron import ConfigurationError


def printed(kind: str | None, capsys: pytest.CaptureFixture[str]) -> str:
    assert PluginsRules().run(Namespace(kind=kind)) == 0
    return " ".join(capsys.readouterr().out.split())


def test_each_rule_of_a_kind_is_printed_and_no_other(capsys: pytest.CaptureFixture[str]) -> None:
    text = printed("acceleration", capsys)
    assert all(rule.id in text for rule in RULES["acceleration"])
    assert "backend/" not in text


def test_without_a_kind_every_rule_is_printed_once(capsys: pytest.CaptureFixture[str]) -> None:
    words = printed(None, capsys).split()
    for rule in (rule for rules in RULES.values() for rule in rules):
        assert words.count(rule.id) == 1


def test_an_unknown_kind_is_refused_with_the_kinds() -> None:
    with pytest.raises(ConfigurationError, match="no kind 'gripper'") as refused:
        PluginsRules().run(Namespace(kind="gripper"))
    assert "backend" in refused.value.hint
