"""For each rule of monitors there is a monitor that breaks it: one that guesses, lies, remembers or
is slow.
"""

from __future__ import annotations

import os
import time
from dataclasses import replace
from typing import Any

import pytest
from pydantic import BaseModel, ConfigDict, Field

from rn_standard.tasks.contract_cases import RULES, MonitorCase, lifted_case
from rn_standard.tasks.detectors import ColourLifted
from rn_standard.tasks.monitor import Score
from rn_testing.rule import RuleVerdict
from rn_testing.verification import verify


class Ignored(BaseModel):
    model_config = ConfigDict(extra="forbid")

    gain: float = Field(default=1.0, description="gain")


class Good(ColourLifted):
    """The good one, its scores changed."""

    def change(self, score: Score) -> Score:
        return score

    def score(self, observation: Any) -> Score:
        return self.change(super().score(observation))


class SaysYes(Good):
    def change(self, score):
        return Score(value=1.0, reason="it is done")


class SaysNo(Good):
    def change(self, score):
        return Score(value=0.0, reason="it is not done")


class Inverted(Good):
    def change(self, score):
        return score if score.value is None else replace(score, value=1.0 - score.value)


class NeverSure(Good):
    def change(self, score):
        return Score(value=None, reason="nobody knows")


class GuessesBlind(Good):
    def change(self, score):
        return Score(value=0.5, reason="perhaps") if score.value is None else score


class Latches(Good):
    """Once it has seen it, it says so until the next reset."""

    done = False

    def reset(self, observation):
        self.done = False
        super().reset(observation)

    def change(self, score):
        self.done = self.done or (score.value or 0.0) > 0.9
        return Score(value=1.0, reason="it was done") if self.done else score


class NeedsImages(Good):
    def reset(self, observation):
        observation.frames["primary"]
        super().reset(observation)


class InPercent(Good):
    def change(self, score):
        return replace(score, value=100.0 * (score.value or 0.0))


class IsNan(Good):
    def change(self, score):
        return replace(score, value=float("nan"))


class HasNoProgress(Good):
    def change(self, score):
        return replace(score, progress=float("nan"))


class FailsTwice(Good):
    def change(self, score):
        return replace(score, failure=2.0)


class SaysNothing(Good):
    def change(self, score):
        return replace(score, reason="")


class SaysTooMuch(Good):
    def change(self, score):
        return replace(score, reason="because " * 1000)


class IsAnumber(Good):
    def change(self, score):
        return score.value


class Draws(Good):
    def change(self, score):
        return replace(score, reason=f"looked at {time.perf_counter_ns()}")


class Remembers(Good):
    count = 0

    def change(self, score):
        self.count += 1
        return replace(score, reason=f"look {self.count}")


class Paints(Good):
    def score(self, observation):
        observation.frames.clear()
        return Score(value=None, reason="no image")


class IsSlow(Good):
    def change(self, score):
        time.sleep(0.07)
        return score


class ReadsAFile(Good):
    def __init__(self, config):
        open("/proc/self/status", "rb").close()
        super().__init__(config)


class Prints(Good):
    def change(self, score):
        print(score)
        return score


class ChangesTheFolder(Good):
    def reset(self, observation):
        os.chdir("/")
        super().reset(observation)


class NoReset:
    def __init__(self, config):
        pass

    def score(self, observation):
        return Score(value=None, reason="nothing to say")


class IgnoresOptions(Good):
    def __init__(self, config):
        super().__init__(None)


MUTANTS: list[tuple[str, type, dict[str, object]]] = [
    ("protocol", NoReset, {}),
    ("constructor-pure", ReadsAFile, {}),
    ("options-read", IgnoresOptions, {"config": f"{__name__}:Ignored"}),
    ("process-left-alone", Prints, {}),
    ("process-left-alone", ChangesTheFolder, {}),
    ("input-kept", Paints, {}),
    ("score-quick", IsSlow, {}),
    ("undone-is-not-achieved", Latches, {}),
    ("achieved-scores-high", SaysNo, {}),
    ("achieved-scores-high", Inverted, {}),
    ("missed-scores-low", SaysYes, {}),
    ("missed-scores-low", NeverSure, {}),
    ("blind-is-not-judged", GuessesBlind, {}),
    ("blind-start-is-no-error", NeedsImages, {}),
    ("score-has-its-form", InPercent, {}),
    ("score-has-its-form", IsNan, {}),
    ("score-has-its-form", HasNoProgress, {}),
    ("score-has-its-form", FailsTwice, {}),
    ("score-has-its-form", SaysNothing, {}),
    ("score-has-its-form", SaysTooMuch, {}),
    ("score-has-its-form", IsAnumber, {}),
    ("repeatable", Draws, {}),
    ("reset-forgets", Remembers, {}),
]


def broken_case(
    target: type, spec: dict[str, object], monkeypatch: pytest.MonkeyPatch
) -> MonitorCase:
    """The good case with the class as its target."""
    good = lifted_case()
    monkeypatch.setattr(MonitorCase, "_target", lambda self, descriptor: target)
    return replace(good, spec=replace(good.spec, **spec))


@pytest.mark.sampled(every=5)
@pytest.mark.parametrize(
    ("name", "target", "spec"), MUTANTS, ids=lambda value: getattr(value, "__name__", "")
)
def test_a_broken_monitor_fails_its_rule(name, target, spec, monkeypatch):
    rule = next(rule for rule in RULES if rule.id == f"monitor/{name}")
    assert verify(rule, lifted_case()).verdict is RuleVerdict.PASSED
    outcome = verify(rule, broken_case(target, spec, monkeypatch))
    assert outcome.verdict is RuleVerdict.FAILED, outcome
    assert outcome.detail


def test_every_rule_has_a_monitor_that_breaks_it():
    assert {f"monitor/{name}" for name, _, _ in MUTANTS} == {
        r.id for r in RULES if r.id.startswith("monitor/")
    }
