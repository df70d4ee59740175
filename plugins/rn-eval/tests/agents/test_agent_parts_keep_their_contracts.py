"""Every task and subject that this package offers keeps the contract of its kind."""

from __future__ import annotations

import pytest

from rn_eval.agents.contract_cases import (
    SUBJECTS,
    TASKS,
    AgentSubjectCase,
    AgentTaskCase,
    nothing_seen,
    perfect_case,
)
from rn_eval.agents.offers import TASKS as OFFERED_TASKS
from rn_eval.hooks import AgentSubjectSpec, AgentTaskSpec
from rn_eval.plugin import RELABELLED
from rn_eval.plugin import SUBJECTS as OFFERED_SUBJECTS
from rn_testing import LocatorCase, LocatorContract
from rn_testing.contracts import contract_of
from rn_testing.rule import Violation


@pytest.mark.sampled(every=15)
class TestAgentTasks(contract_of(AgentTaskSpec)):
    @pytest.fixture(params=OFFERED_TASKS, ids=lambda spec: spec.name)
    def plugin(self, request: pytest.FixtureRequest) -> AgentTaskCase:
        return AgentTaskCase(spec=request.param)


class TestAgentSubjects(contract_of(AgentSubjectSpec)):
    # "chat" needs a separate library and has its own test: test_a_chat_model_is_an_agent.py
    @pytest.fixture(
        params=[spec for spec in OFFERED_SUBJECTS if not spec.requires], ids=lambda spec: spec.name
    )
    def plugin(self, request: pytest.FixtureRequest) -> AgentSubjectCase:
        return AgentSubjectCase(spec=request.param)


class TestRelabelled(LocatorContract):
    @pytest.fixture
    def plugin(self) -> LocatorCase:
        return LocatorCase(spec=RELABELLED)


def test_a_subject_that_is_not_async_is_refused(monkeypatch):
    monkeypatch.setattr(
        "rn_eval.agents.subjects.perfect.act", lambda tools, briefing: "CLAIM: done"
    )
    case = perfect_case()
    (own,) = [rule for rule in SUBJECTS.rules if rule.id.startswith("agent-subject/")]
    with pytest.raises(Violation, match="no async function"):
        own.check(case)


def test_every_task_of_a_family_that_waits_for_nobody_has_bounds():
    """Of the others, somebody else decides how often an agent has to ask."""
    unbounded = {spec.family for spec in OFFERED_TASKS if not spec.most_calls}
    assert unbounded == {"stop", "recover", "again", "clients", "several"}
    assert all(bool(spec.most_calls) == bool(spec.most_bytes) for spec in OFFERED_TASKS)
    assert len({spec.name for spec in OFFERED_TASKS}) == len(OFFERED_TASKS) == 94


class Unfair:
    """A task that breaks each rule."""

    wordings = ("{missing}", "{missing}")
    difficulty = 4
    time_limit_s = 0.0

    def __init__(self, config):
        self.count = 0

    def prepare(self, seed):
        self.count += 1
        from rn_eval.agents.task import AgentScene

        return AgentScene(seed=self.count, instruction="{missing}")

    def judge(self, scene, truth, conduct):
        from rn_eval.agents.task import AgentVerdict

        assert truth.is_empty == nothing_seen().is_empty
        return AgentVerdict(success=True)


def test_every_rule_of_tasks_can_fail(monkeypatch):
    monkeypatch.setattr(AgentTaskCase, "build", lambda self: Unfair(None))
    case = AgentTaskCase(spec=OFFERED_TASKS[0])
    own = [rule for rule in TASKS.rules if rule.id.startswith("agent-task/")]
    assert len(own) == 4
    for rule in own:
        with pytest.raises(Violation):
            rule.check(case)
