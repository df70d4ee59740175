"""Costs of the same episodes before and after: only episodes of both runs count."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from agent_stage import Stage, said

from rn_eval.agents.base_truth import BaseTruth
from rn_eval.agents.compare import HEADINGS, compare_agents
from rn_eval.agents.episode import episode_digest
from rn_eval.agents.record import AgentCosts, AgentKey, AgentOutcome, AgentPlan, AgentRecord
from rn_eval.agents.task import AgentScene
from rn_eval.agents.truth import Truth
from rn_eval.ledger import RunLedger
from roboneuron import ConfigurationError
from roboneuron.cli.main import main


def record(
    task: str, calls: int, answers: int, *, status="success", seed=0, digest=""
) -> AgentRecord:
    return AgentRecord(
        key=AgentKey(subject="perfect", task=task, seed=seed),
        family=task.partition("-")[0],
        difficulty=1,
        instruction="Pick.",
        outcome=AgentOutcome(status=status, calls=calls, failed_calls=calls - 1, digest=digest),
        costs=AgentCosts(answer_bytes=answers, list_bytes=36_000),
    )


def run_of(folder: Path, *records: AgentRecord) -> Path:
    tasks = tuple(dict.fromkeys(one.key.task for one in records))
    with RunLedger(folder, AgentPlan, AgentRecord) as ledger:
        ledger.open(AgentPlan(subjects=("perfect",), tasks=tasks, seeds=9))
        for one in records:
            ledger.add(one)
    return folder


@pytest.fixture
def before(tmp_path: Path) -> Path:
    return run_of(
        tmp_path / "before",
        record("pick-colour", 6, 9000, status="failure", digest="c"),
        record("pick-middle", 4, 5000, digest="a"),
        record("look-count", 3, 1000),
        record("move-by", 2, 1000, status="error"),
        record("put-at", 2, 1000),
    )


@pytest.fixture
def after(tmp_path: Path) -> Path:
    return run_of(
        tmp_path / "after",
        record("pick-colour", 2, 4000, digest="d"),
        record("pick-middle", 2, 4000, digest="a"),
        record("look-count", 3, 2000),
        record("move-by", 2, 1000),
        record("put-at", 2, 1000, status="error"),
        record("pick-colour", 9, 9000, seed=1),
    )


def test_only_episodes_with_a_verdict_in_both_count(before: Path, after: Path):
    table = compare_agents(before, after)
    rows = [dict(zip(HEADINGS, row, strict=True)) for row in table.rows]
    assert [(row["family"], row["episodes"], row["the same"]) for row in rows] == [
        ("look", "1", "-"),
        ("pick", "2", "1"),
        ("all", "3", "1"),
    ]
    pick = rows[1]
    assert (pick["success"], pick["calls"], pick["failed calls"]) == (
        *("1 → 2", "4.0 → 2.0", "3.0 → 1.0"),
    )
    assert pick["kB of answers"] == "5.0 → 4.0"
    assert rows[2]["kB of lists"] == "36.0 → 36.0"


def test_the_command_prints_the_table(before: Path, after: Path, capsys):
    assert main(["eval", "agents", "--compare", str(before), str(after)]) == 0
    assert "| perfect | pick   | 2        | 1        | 1 → 2" in capsys.readouterr().out


def test_runs_without_a_common_episode_are_an_error(before: Path, tmp_path: Path):
    other = run_of(tmp_path / "other", record("stop-all", 1, 1))
    with pytest.raises(ConfigurationError, match="no episode in common"):
        compare_agents(before, other)


def test_a_digest_is_of_the_episode_without_its_times():
    scene = AgentScene(seed=3, instruction="")
    truth, conduct = Stage(scene).by(dx=0.1).truth(), said(calls=("move_ee",))
    digest = episode_digest(truth, conduct)
    later = replace(truth, t_s=truth.t_s + 0.7)
    slower = conduct.model_copy(
        update={
            "wall_s": 9.0,
            "calls": tuple(
                c.model_copy(update={"at_s": 5.0, "took_s": 2.0}) for c in conduct.calls
            ),
        }
    )
    assert episode_digest(later, slower) == digest
    elsewhere = replace(truth, joints_rad=truth.joints_rad + 2e-6)
    moved = replace(truth, cubes_m=truth.cubes_m + 2e-6)
    others = (
        (elsewhere, conduct),
        (moved, conduct),
        (truth, said(calls=("move_ee", "move_ee"))),
        (truth, said("not done", calls=("move_ee",))),
        (replace(truth, others={"b": truth}), conduct),
        (replace(truth, bases={"b": BaseTruth(t_s=truth.t_s, poses=truth.tcp_m)}), conduct),
    )
    assert digest not in [episode_digest(*other) for other in others]
    assert len(episode_digest(Truth.nothing(), conduct)) == 16
