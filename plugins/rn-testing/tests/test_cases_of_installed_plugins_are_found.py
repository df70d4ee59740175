"""`plugins check` tests a plugin with its author's case, or with one made from the descriptor
alone.
"""

from __future__ import annotations

import io
import json
from dataclasses import replace

import pytest

from rn_testing import BackendCase, RobotCase, RuleVerdict, check, fakes, verify
from rn_testing.automatic import make_case
from rn_testing.rules import RULES
from roboneuron.errors import PluginError

CASES = """
from rn_testing import BackendCase
from rn_testing.fakes import FAKE_BACKEND, FAKE_ROBOT
from dataclasses import replace

SPEC = replace(FAKE_BACKEND, case="shipped_cases:good")

def good(): return BackendCase(spec=SPEC, options={"horizon": 3, "delta_m": 0.0})
def other(): return BackendCase(spec=replace(SPEC, name="other"))
def wrong(): return 3
text = "no function"
"""


@pytest.fixture
def shipped(site):
    (site.path / "shipped_cases.py").write_text(CASES)
    return replace(fakes.FAKE_BACKEND, case="shipped_cases:good")


def test_without_a_case_one_is_made_and_marked(shipped):
    case = make_case(fakes.FAKE_ROBOT, {})
    assert isinstance(case, RobotCase)
    assert case.is_automatic


def test_the_shipped_case_is_used_with_the_callers_options_on_top(shipped):
    case = make_case(shipped, {"horizon": 2})
    assert not case.is_automatic
    assert case.options == {"horizon": 2, "delta_m": 0.0}


@pytest.mark.parametrize(
    ("attribute", "words"),
    [
        ("other", "of this descriptor"),
        ("wrong", "returned int"),
        ("text", "expected a function"),
        ("no", "no attribute"),
    ],
)
def test_a_case_that_is_none_is_the_plugins_fault(shipped, attribute, words):
    with pytest.raises(PluginError, match=words):
        make_case(replace(shipped, case=f"shipped_cases:{attribute}"), {})


def test_what_cannot_start_is_skipped_for_an_automatic_case_and_fails_for_an_authors():
    rule = next(r for r in RULES["backend"] if r.id == "backend/predict-within-horizon")
    options = {"horizon": 999}
    automatic = verify(
        rule, BackendCase(spec=fakes.FAKE_BACKEND, options=options, is_automatic=True)
    )
    assert automatic.verdict is RuleVerdict.SKIPPED
    assert "plugins.instant.horizon = 999" in automatic.detail
    assert (
        verify(rule, BackendCase(spec=fakes.FAKE_BACKEND, options=options)).verdict
        is RuleVerdict.FAILED
    )


def test_an_automatic_robot_case_moves_nothing_but_a_simulation():
    drivers = (replace(fakes.FAKE_ROBOT.drivers[0], name="hardware"),)
    case = make_case(replace(fakes.FAKE_ROBOT, drivers=drivers), {})
    outcomes = [verify(rule, case) for rule in RULES["robot"] if rule.id.startswith("driver/")]
    assert {o.verdict for o in outcomes} == {RuleVerdict.SKIPPED}


def test_the_worker_writes_a_line_before_and_after_each_rule(monkeypatch):
    monkeypatch.setattr(check, "discover", lambda: fakes.fake_registry())
    out = io.StringIO()
    check.run(
        {
            "distribution": "rn-fakes",
            "plugin": "rn-fakes",
            "offers": [("backend", "instant")],
            "options": {},
        },
        out,
    )
    lines = [json.loads(line) for line in out.getvalue().splitlines()]
    begun, decided = lines[0::2], lines[1::2]
    assert [b["rule"] for b in begun] == [d["rule"] for d in decided]
    assert all("verdict" not in b for b in begun)
    by_subject = {d["subject"]: set() for d in decided}
    for line in decided:
        by_subject[line["subject"]].add(line["verdict"])
    assert by_subject == {"rn-fakes": {"failed"}, "backend instant": {"passed", "skipped"}}


def test_the_worker_reports_a_broken_case_under_every_rule(monkeypatch, shipped):
    broken = replace(shipped, name="odd", case="shipped_cases:wrong")
    monkeypatch.setattr(check, "discover", lambda: fakes.fake_registry(broken))
    out = io.StringIO()
    check.run(
        {
            "distribution": "rn-fakes",
            "plugin": "rn-fakes",
            "offers": [("backend", "odd")],
            "options": {},
        },
        out,
    )
    lines = [json.loads(line) for line in out.getvalue().splitlines()]
    details = {x["detail"] for x in lines if x["subject"] == "backend odd" and "verdict" in x}
    assert len(details) == 1
    assert "there is no case to try" in details.pop()
