"""A run ends with the simulator's word, else the backend's, else nobody's; faults end it when they
last.
"""

from __future__ import annotations

import json

import pytest

from rn_standard.console.judge import RunJudge, RunOutcome
from rn_standard.console.status import ReportedModule, ServerStatus

INSTRUCTION = "Pick up the red cube."


def status(
    *,
    lifted: dict[str, float] | None = None,
    done: str | None = None,
    health: str = "ok",
    stopped: bool = False,
) -> ServerStatus:
    detail = {"seed": "3", "engine": "{not JSON"}
    if lifted is not None:
        objects = {name: {"lifted_m": 0.2 if s else 0.0, "held_s": s} for name, s in lifted.items()}
        detail["cubes"] = json.dumps(objects)
    metrics = {} if done is None else {"done": done}
    return ServerStatus(
        emergency_stop=stopped,
        emergency_stop_cause="ada: smoke",
        modules=(
            ReportedModule(module="robot", health="ok", pid=1, detail=detail),
            ReportedModule(module="inference", health=health, pid=2, metrics=metrics),
        ),
    )


@pytest.mark.parametrize(
    ("seen", "elapsed_s", "outcome", "reason"),
    [
        (
            status(lifted={"red": 1.2, "blue": 0.0}),
            5.0,
            RunOutcome.DONE,
            "the simulator says that red is lifted by 20 cm",
        ),
        (status(lifted={"red": 0.4}), 5.0, None, ""),
        (status(lifted={"blue": 3.0}), 5.0, None, ""),  # another one was lifted
        (
            status(lifted={"red": 0.0}),
            60.0,
            RunOutcome.NOT_DONE,
            "60 s are over and red is not lifted",
        ),
        (status(done="1"), 5.0, RunOutcome.DONE, "the backend reports that it has finished"),
        (status(done="0"), 5.0, None, ""),
        (status(done="0"), 60.0, RunOutcome.NOT_DONE, "the backend has not finished"),
        (status(done="nonsense"), 5.0, None, ""),
        (status(), 60.0, RunOutcome.UNKNOWN, "neither the backend nor a simulator tells"),
        (
            status(stopped=True),
            1.0,
            RunOutcome.NOT_DONE,
            "the emergency stop was latched by ada: smoke",
        ),
    ],
)
def test_one_look_decides(
    seen: ServerStatus, elapsed_s: float, outcome: RunOutcome | None, reason: str
) -> None:
    verdict = RunJudge(INSTRUCTION, 60.0).look(seen, elapsed_s)
    if outcome is None:
        assert verdict is None
    else:
        assert verdict is not None
        assert (verdict.outcome, reason in verdict.reason) == (outcome, True), verdict.reason


def test_a_short_fault_is_forgiven_and_a_lasting_one_ends_the_run() -> None:
    judge = RunJudge(INSTRUCTION, 60.0)
    assert judge.look(status(health="failing"), 1.0) is None
    assert judge.look(status(), 3.0) is None
    assert judge.look(status(health="silent"), 4.0) is None
    assert judge.look(status(health="silent"), 7.9) is None
    verdict = judge.look(status(health="silent"), 8.1)
    assert verdict is not None
    assert verdict.outcome is RunOutcome.NOT_DONE
    assert verdict.reason == "inference: alive, but not reporting"


def test_a_module_that_somebody_stopped_ends_the_run() -> None:
    judge = RunJudge(INSTRUCTION, 60.0)
    assert judge.look(status(health="stopped"), 1.0) is None
    verdict = judge.look(status(health="stopped"), 6.0)
    assert verdict is not None
    assert verdict.outcome is RunOutcome.NOT_DONE


def test_the_backends_word_does_not_outweigh_the_simulators() -> None:
    judge = RunJudge(INSTRUCTION, 60.0)
    assert judge.look(status(lifted={"red": 0.0}, done="1"), 1.0) is None
    verdict = judge.look(status(lifted={"red": 0.0}, done="1"), 6.0)
    assert verdict is not None
    assert verdict.outcome is RunOutcome.NOT_DONE
    assert "the simulator that red is lifted by 0 cm" in verdict.reason


def test_exit_statuses_tell_the_outcomes_apart() -> None:
    assert [
        int(o)
        for o in (RunOutcome.DONE, RunOutcome.NOT_DONE, RunOutcome.UNKNOWN, RunOutcome.INTERRUPTED)
    ] == [0, 1, 3, 130]
