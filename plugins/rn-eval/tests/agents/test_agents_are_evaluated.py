"""`roboneuron eval agents` with real servers: a small run of about a minute."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from rn_eval.agents.record import AgentPlan, AgentRecord
from rn_eval.ledger import read_plan_of, read_records_of
from rn_testing.domain import free_ros_domain

ROOT = Path(__file__).parents[4]
pytestmark = [pytest.mark.ros, pytest.mark.timeout(240)]


def evaluate(folder: Path, environment: dict[str, str], *options: str) -> str:
    command = [sys.executable, "-m", "roboneuron.cli.main", "eval", "agents"]
    done = subprocess.run(
        [*command, "--out", str(folder), *options],
        env=environment,
        capture_output=True,
        text=True,
        timeout=220,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture
def environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(free_ros_domain()))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setenv("AGENT_EVAL_HOSTILE_ATTEMPTS", "60")
    return {k: v for k, v in os.environ.items() if not k.startswith("PYTEST_")}


@pytest.mark.slow
def test_reference_agents_and_one_that_never_ends(tmp_path: Path, environment: dict[str, str]):
    """A successful pick; a hostile agent, without forbidden motion; an agent that hangs with its
    process group; and the agent of the documentation.
    """
    folder = tmp_path / "run"
    evaluate(folder, environment, "--subject", "perfect,hostile", "--tasks", "pick-colour")
    marker = str(tmp_path / "hangs")
    hangs = f"hangs=sh -c 'touch {marker}; sleep 1000 & echo CLAIM: done; wait'"
    options = ("--subject-command", hangs, "--tasks", "move-by", "--max-s", "3")
    other = tmp_path / "hanging"
    evaluate(other, environment, *options)
    example = tmp_path / "my_agent.py"
    page = (ROOT / "docs" / "agents.md").read_text(encoding="utf-8")
    example.write_text(page.partition("```python\n")[2].partition("```")[0], encoding="utf-8")
    mine = f"mine={sys.executable} {example}"
    third = tmp_path / "third"
    evaluate(third, environment, "--subject-command", mine, "--tasks", "pick-colour")

    by_subject = {r.key.subject: r for r in read_records_of(folder, AgentRecord)}
    perfect, hostile = by_subject["perfect"], by_subject["hostile"]
    assert perfect.outcome.status == "success", perfect.outcome
    assert perfect.outcome.honest is True
    assert perfect.outcome.left_safe
    assert perfect.costs.samples > 100
    assert perfect.costs.answer_bytes > 500
    assert [call.tool for call in perfect.calls] == ["start_all", "run_task"]

    assert hostile.outcome.status == "failure"
    assert hostile.outcome.forbidden == {}
    assert hostile.outcome.left_safe
    assert hostile.outcome.calls == 65
    assert hostile.outcome.moved
    assert hostile.outcome.unsafe["after_stop"] >= 1
    assert {"release", "unknown_tool", "bounds"} <= set(hostile.outcome.unsafe)

    (hung,) = read_records_of(other, AgentRecord)
    assert Path(marker).exists()
    assert hung.outcome.ended == "timed out"
    assert hung.outcome.claim == "done"
    kept = {path.name for path in (other / "failed" / hung.key.slug).iterdir()}
    assert hung.strip == ""
    assert (folder / "strips" / hostile.strip).stat().st_size > 5000
    assert {"roboneuron.toml", "server.log", "agent.log", "words.txt"} <= kept
    assert not (folder / "failed" / perfect.key.slug).exists()
    assert hung.outcome.honest is False
    assert hung.costs.wall_s < 15
    assert read_plan_of(other, AgentPlan).commands == {"hangs": hangs.partition("=")[2]}

    (of_the_page,) = read_records_of(third, AgentRecord)
    assert [call.tool for call in of_the_page.calls] == ["start_all", "run_task"]
    assert of_the_page.outcome.claim == "done"
    assert of_the_page.outcome.ended == "exited"

    told = evaluate(folder, environment, "--resume", str(folder))
    assert "episodes are left" not in told
    assert "| perfect" in told


@pytest.mark.slow
def test_two_workers_share_the_episodes_and_their_ledger(
    tmp_path: Path, environment: dict[str, str]
):
    """One episode already exists; both workers run episodes, each with its own cells. A joint move
    ends at the same position on either worker, to a millionth.
    """
    pytest.importorskip("ray", reason="needs the extra rn-eval[ray]")
    folder = tmp_path / "run"
    evaluate(folder, environment, "--subject", "perfect", "--tasks", "refuse-coffee")
    tasks = "refuse-coffee,refuse-two,stop-emergency,explain-running,move-joint"
    options = ("--subject", "perfect", "--tasks", tasks, "--workers", "2")
    told = evaluate(folder, environment, *options)
    assert "4 of 5 episodes are left." in told
    records = read_records_of(folder, AgentRecord)
    assert {record.outcome.status for record in records} == {"success"}
    assert len({record.pid for record in records}) == 3
    assert "episodes are left" not in evaluate(folder, environment, *options)
    alone = tmp_path / "alone"
    evaluate(alone, environment, "--subject", "perfect", "--tasks", "move-joint")
    (again,) = read_records_of(alone, AgentRecord)
    (once,) = [record for record in records if record.key.task == "move-joint"]
    assert once.outcome.moved
    assert once.outcome.digest == again.outcome.digest


@pytest.mark.exhaustive
def test_the_truth_of_a_base_beside_an_arm_is_seen(tmp_path: Path, environment: dict[str, str]):
    """The judge gets the base's pose only from its simulator."""
    folder = tmp_path / "run"
    evaluate(folder, environment, "--subject", "perfect", "--tasks", "several-drive")
    (record,) = read_records_of(folder, AgentRecord)
    assert record.outcome.status == "success", record.outcome
    assert record.outcome.moved
    assert {call.robot for call in record.calls} == {"base"}


@pytest.mark.exhaustive
def test_agents_may_reach_the_server_over_http(tmp_path: Path, environment: dict[str, str]):
    folder = tmp_path / "run"
    options = ("--subject", "perfect", "--tasks", "look-table", "--transport", "http")
    evaluate(folder, environment, *options)
    (record,) = read_records_of(folder, AgentRecord)
    assert record.outcome.status == "success", record.outcome
    assert [call.code for call in record.calls] == ["", "", ""]
    assert record.costs.answer_bytes > 2000
    assert read_plan_of(folder, AgentPlan).transport == "http"
