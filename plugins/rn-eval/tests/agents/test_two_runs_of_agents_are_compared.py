"""What the same episodes cost before and after: only those that both runs have."""

from __future__ import annotations

from pathlib import Path

import pytest

from rn_eval.agents.compare import HEADINGS, compare_agents
from rn_eval.agents.record import AgentCosts, AgentKey, AgentOutcome, AgentPlan, AgentRecord
from rn_eval.ledger import RunLedger
from roboneuron import ConfigurationError
from roboneuron.cli.main import main


def record(task: str, calls: int, answers: int, *, status="success", seed=0) -> AgentRecord:
    return AgentRecord(
        key=AgentKey(subject="perfect", task=task, seed=seed),
        family=task.partition("-")[0],
        difficulty=1,
        instruction="Pick.",
        outcome=AgentOutcome(status=status, calls=calls, failed_calls=calls - 1),
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
        record("pick-colour", 6, 9000, status="failure"),
        record("pick-middle", 4, 5000),
        record("look-count", 3, 1000),
        record("move-by", 2, 1000, status="error"),
        record("put-at", 2, 1000),
    )


@pytest.fixture
def after(tmp_path: Path) -> Path:
    return run_of(
        tmp_path / "after",
        record("pick-colour", 2, 4000),
        record("pick-middle", 2, 4000),
        record("look-count", 3, 2000),
        record("move-by", 2, 1000),
        record("put-at", 2, 1000, status="error"),
        record("pick-colour", 9, 9000, seed=1),
    )


def test_only_episodes_with_a_verdict_in_both_count(before: Path, after: Path):
    table = compare_agents(before, after)
    rows = [dict(zip(HEADINGS, row, strict=True)) for row in table.rows]
    assert [(row["family"], row["episodes"]) for row in rows] == [
        ("look", "1"),
        ("pick", "2"),
        ("all", "3"),
    ]
    pick = rows[1]
    assert (pick["success"], pick["calls"], pick["failed calls"]) == (
        *("1 → 2", "5.0 → 2.0", "4.0 → 1.0"),
    )
    assert pick["kB of answers"] == "7.0 → 4.0"
    assert rows[2]["kB of lists"] == "36.0 → 36.0"


def test_the_command_prints_the_table(before: Path, after: Path, capsys):
    assert main(["eval", "agents", "--compare", str(before), str(after)]) == 0
    assert "| perfect | pick   | 2        | 1 → 2" in capsys.readouterr().out


def test_runs_without_a_common_episode_are_an_error(before: Path, tmp_path: Path):
    other = run_of(tmp_path / "other", record("stop-all", 1, 1))
    with pytest.raises(ConfigurationError, match="no episode in common"):
        compare_agents(before, other)
