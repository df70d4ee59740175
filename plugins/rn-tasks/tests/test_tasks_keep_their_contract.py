"""The feature, its monitors and its package keep their contracts; a monitor that guesses is caught."""

from dataclasses import replace

import pytest

from rn_selection.plugin import FEATURE as SELECTION
from rn_tasks.contract_cases import CASES, RULES, MonitorCase, lifted_case
from rn_tasks.monitor import Score
from rn_tasks.plugin import FEATURE
from rn_testing import FeatureCase, FeatureContract, PackageCase, PackageContract
from rn_testing.rule import Verdict, verify


class TestTasks(FeatureContract):
    @pytest.fixture
    def plugin(self) -> FeatureCase:
        return FeatureCase(
            spec=FEATURE,
            needs=(SELECTION,),
            options={"postures": {"rest": {"joints": {"joint1": 0.1}}}, "tasks": {"max_s": 30.0}},
        )


class TestPackage(PackageContract):
    @pytest.fixture
    def plugin(self) -> PackageCase:
        return PackageCase(distribution="rn-tasks")


@pytest.mark.parametrize("make", CASES, ids=lambda make: make.__name__)
@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.id)
def test_shipped_monitors_keep_every_rule(make, rule):
    outcome = verify(rule, make())
    assert outcome.verdict is Verdict.PASSED, f"{outcome.detail}\n{outcome.traceback}"


class Guesser:
    """Says yes to everything, with a counter that `reset` does not forget."""

    def __init__(self, config=None):
        self.count = 0

    def reset(self, observation):
        pass

    def score(self, observation):
        self.count += 1
        return Score(value=1.0, reason=f"look {self.count}.")


def test_a_monitor_that_guesses_breaks_the_rules():
    class GuesserCase(MonitorCase):
        def build(self):
            return Guesser()

    good = lifted_case()
    case = GuesserCase(spec=replace(good.spec), before=good.before, achieved=good.achieved, missed=good.missed)
    broken = {rule.id for rule in RULES if verify(rule, case).verdict is Verdict.FAILED}
    assert broken == {
        "monitor/missed-scores-low",
        "monitor/blind-is-not-judged",
        "monitor/score-has-its-form",
        "monitor/reset-forgets",
    }
