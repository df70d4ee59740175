"""The suite "hand-over": a policy with TCP poses of two arms runs through controller and limits,
and is judged by which arm holds the cube.
"""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from rn_eval.hand_over import HandOver, HandOverScene, HandOverSuiteOptions
from rn_eval.plan import EvalPlan
from rn_eval.policy import AgreedPolicy
from rn_eval.runner import Runner
from rn_simulation.ground_truth import CubeState
from roboneuron import ActionChunk, InvalidInputError
from roboneuron.config import load_config


def plan(**changes: Any) -> EvalPlan:
    config = load_config(None).model_dump(mode="json")
    given = {"suite": "hand-over", "backend": "servo-pair", "episodes": 1, "config": config}
    return EvalPlan.model_validate({**given, "first_seed": 3, **changes})


@pytest.mark.slow  # the servo's own tests include a handover
def test_a_policy_of_two_arms_hands_the_named_cube_over() -> None:
    runner = Runner(plan())
    try:
        (episode,) = HandOver(None).episodes(1, 3)
        (job,) = plan().jobs([episode])
        record, _ = runner.run(job)
    finally:
        runner.close()
    assert record.outcome.status == "success", record.outcome.reason
    facts = record.outcome.facts
    assert float(facts["handed_over_s"]) >= 1.0
    assert record.key.task == f"hand-over-{facts['target']}"
    assert record.instruction == f"hand over the {facts['target']} cube"


def test_rows_that_were_not_agreed_on_are_refused() -> None:
    runner = Runner(plan())
    assert runner._agreement is not None
    policy: Any = SimpleNamespace(
        predict=lambda observation: ActionChunk(actions=[[0.0] * 6 + [1.0]], step_s=0.1),
        reset=lambda: None,
        close=lambda: None,
    )
    asked: Any = SimpleNamespace(joints=None)
    with pytest.raises(InvalidInputError, match="The backend answered in"):
        AgreedPolicy(policy, runner._agreement).predict(asked)
    runner.close()


@pytest.mark.parametrize(
    ("handed", "is_over", "reason"),
    [
        ({"red": 1.0}, True, ""),
        ({"red": 0.9}, False, "was not handed over"),
        ({"blue": 1.0}, True, "The blue cube was handed over instead of the red one."),
        ({}, False, "was not handed over"),
    ],
)
def test_only_the_named_cube_in_the_other_hand_is_a_success(
    handed: dict[str, float], is_over: bool, reason: str
) -> None:
    scene = HandOverScene.__new__(HandOverScene)
    cube = CubeState(
        name="red", edge_m=0.04, position_m=[0, 0, 0], quaternion_xyzw=[0, 0, 0, 1],
        lifted_m=0.3, held_s=2.0,
    )  # fmt: skip
    cubes = {name: replace(cube, handed_over_s=handed.get(name, 0.0)) for name in ("red", "blue")}
    scene._simulation = SimpleNamespace(cubes=lambda: cubes)  # type: ignore[assignment]
    scene._target, scene._options = "red", HandOverSuiteOptions()
    judged = scene.judge()
    assert (judged.success, judged.is_over) == (handed.get("red") == 1.0, is_over)
    assert reason in judged.reason
