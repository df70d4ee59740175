"""For each rule of teleoperators there is one that breaks it."""

from __future__ import annotations

import os
import time
from dataclasses import replace
from typing import Any

import pytest

from rn_standard.teleoperation.contract_cases import RULES, TeleoperatorCase, twist_case
from rn_standard.teleoperation.topic_sources import TwistTopic
from rn_testing.rule import RuleVerdict
from rn_testing.verification import verify


class NoRead(TwistTopic):
    read = None  # type: ignore[assignment]


class OpensEarly(TwistTopic):
    def __init__(self, config: Any, profile: Any) -> None:
        super().__init__(config, profile)
        open("/proc/self/status", "rb").close()


class LeavesTraces(TwistTopic):
    def close(self) -> None:
        super().close()
        os.environ["RN_BROKEN_TELEOPERATOR"] = str(time.monotonic())


class GivesAll(TwistTopic):
    def read(self, timeout_s: float) -> Any:
        sample = super().read(timeout_s)
        return sample and replace(sample, velocities={"x": 0.1})


class AlwaysHeld(TwistTopic):
    def read(self, timeout_s: float) -> Any:
        sample = super().read(timeout_s)
        return sample and replace(sample, is_held=True)


class WallClock(TwistTopic):
    def read(self, timeout_s: float) -> Any:
        sample = super().read(timeout_s)
        return sample and replace(sample, at_s=time.time())


class Sleepy(TwistTopic):
    def read(self, timeout_s: float) -> Any:
        time.sleep(0.2)
        return super().read(timeout_s)


class StaysOpen(TwistTopic):
    def close(self) -> None:
        pass


MUTANTS: list[tuple[str, type]] = [
    ("protocol", NoRead),
    ("constructor-pure", OpensEarly),
    ("process-left-alone", LeavesTraces),
    ("gives-what-it-declares", GivesAll),
    ("switch-is-told", AlwaysHeld),
    ("clock-is-ours", WallClock),
    ("read-is-bounded", Sleepy),
    ("close-releases", StaysOpen),
]


@pytest.mark.parametrize(
    ("name", "target"), MUTANTS, ids=lambda value: getattr(value, "__name__", "")
)
def test_a_teleoperator_that_breaks_the_rule_fails_it(
    name: str, target: type, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RN_BROKEN_TELEOPERATOR", "")
    rule = next(rule for rule in RULES if rule.id == f"teleoperator/{name}")
    assert verify(rule, twist_case()).verdict is RuleVerdict.PASSED
    monkeypatch.setattr(TeleoperatorCase, "_target", lambda self, descriptor: target)
    outcome = verify(rule, twist_case())
    assert outcome.verdict is RuleVerdict.FAILED, outcome


def test_every_rule_of_teleoperators_has_one_that_breaks_it() -> None:
    own = {rule.id for rule in RULES if rule.id.startswith("teleoperator/")}
    assert own == {f"teleoperator/{name}" for name, _ in MUTANTS}
