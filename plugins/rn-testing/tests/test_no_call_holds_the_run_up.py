"""A call that hangs fails its rule by name, later rules still run, and the cause is attributed
correctly.
"""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from pathlib import Path

import mutants_backend
import pytest

from rn_testing import BackendCase, RobotCase, RuleVerdict, deadline, fakes, verify
from rn_testing.rules import RULES

NEVER = threading.Event()


def rule_of(rule_id):
    kind = {"driver": "robot"}.get(rule_id.partition("/")[0], rule_id.partition("/")[0])
    return next(rule for rule in RULES[kind] if rule.id == rule_id)


@pytest.mark.exhaustive
def test_a_predict_that_blocks_fails_its_rules_and_the_others_are_decided():
    assert mutants_backend.MUTANTS["predict_hangs"].target is not None
    spec = replace(fakes.FAKE_BACKEND, target="mutants_backend:predict_hangs")
    case = BackendCase(spec=spec, limits_s={"predict": 0.1})
    outcomes = {rule.id: verify(rule, case) for rule in RULES["backend"]}
    blocked = outcomes["backend/predict-within-horizon"]
    assert (blocked.verdict, blocked.detail) == (
        RuleVerdict.FAILED,
        "predict did not return within 0.1 s",
    )
    assert outcomes["backend/close-before-load"].verdict is RuleVerdict.PASSED
    assert outcomes["descriptor/well-formed"].verdict is RuleVerdict.PASSED


def test_a_factory_of_the_case_that_blocks_is_bounded_too(monkeypatch):
    monkeypatch.setattr(deadline, "RULE_LIMIT_S", 0.2)
    case = BackendCase(spec=fakes.FAKE_BACKEND, observe=lambda: NEVER.wait(30) and None)
    outcome = verify(rule_of("backend/predict-within-horizon"), case)
    assert outcome.detail == "the rule did not end within 0.2 s"


def test_what_a_rule_raises_reaches_the_outcome_with_its_traceback():
    def observe():
        raise ValueError("no picture")

    outcome = verify(
        rule_of("backend/predict-within-horizon"),
        BackendCase(spec=fakes.FAKE_BACKEND, observe=observe),
    )
    assert outcome.detail == "raised ValueError: no picture"
    assert "observe" in outcome.traceback


def test_a_quick_call_is_not_delayed():
    begun_s = time.monotonic()
    for _ in range(20):
        assert deadline.run_bounded(lambda: 3) == 3
    assert time.monotonic() - begun_s < 5.0


def reading_profile():
    """A profile read from a file."""
    Path(__file__).read_text()
    return fakes.gantry_profile()


def test_a_file_that_the_profile_reads_is_not_blamed_on_the_driver(monkeypatch):
    monkeypatch.setattr(fakes.robot, "read_profile", reading_profile, raising=False)
    spec = replace(fakes.FAKE_ROBOT, target="rn_testing.fakes.robot:read_profile")
    assert (
        verify(rule_of("driver/constructor-pure"), RobotCase(spec=spec)).verdict
        is RuleVerdict.PASSED
    )


@pytest.mark.parametrize("option", ["runtime", "acceleration"])
def test_a_file_that_a_factory_reads_is_not_blamed_on_the_backend(option):
    case = BackendCase(
        spec=fakes.FAKE_BACKEND, **{option: lambda: Path(__file__).read_text() and None}
    )
    assert verify(rule_of("backend/constructor-pure"), case).verdict is RuleVerdict.PASSED
