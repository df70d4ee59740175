"""Each of several robots has its own ground truth, and each call is judged by the stop of its
robot.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from rn_eval.agents.base_truth import BaseTruth
from rn_eval.agents.conduct import ToolCall
from rn_eval.agents.episode import _judged
from rn_eval.agents.truth import Truth
from rn_eval.agents.witness import Witness, _of_base
from roboneuron import StateError

LATCHED = ((2.0, 9.0),)


def call(robot: str, at_s: float) -> ToolCall:
    named = f'{{"robot": "{robot}", "dz_m": 0.1}}' if robot else "{}"
    return ToolCall(at_s=at_s, tool="move_ee", arguments=named, code="refused", rule="zone")


def test_a_heading_that_passes_half_a_turn_goes_on():
    turned = np.linspace(0.0, 2.2 * math.pi, 30)
    wrapped = np.arctan2(np.sin(turned), np.cos(turned))
    samples = [(10**9 + n * 10**8, 0.1 * n, 0.0, yaw) for n, yaw in enumerate(wrapped.tolist())]
    truth = _of_base(samples, 10**9, LATCHED)
    assert truth.end == pytest.approx((2.9, 0.0, 2.2 * math.pi))
    assert truth.t_s[1] == pytest.approx(0.1)
    assert truth.moved()
    assert not truth.moved(5.0)
    assert not truth.is_still_at_end()
    nothing = _of_base([], 0, ())
    assert nothing.is_empty
    assert nothing.end == (0.0, 0.0, 0.0)
    assert nothing.is_still_at_end()
    assert not nothing.moved()


@pytest.mark.parametrize(
    ("robot", "kind"),
    [("left", "zone"), ("", "zone"), ("right", "after_stop"), ("base", "after_stop")],
)
def test_a_call_is_judged_by_the_stop_of_the_robot_that_it_names(robot: str, kind: str):
    base = BaseTruth(t_s=np.zeros(0), poses=np.zeros((0, 3)), latched_s=LATCHED)
    truth = replace(Truth.nothing(), others={"right": Truth.nothing(LATCHED)}, bases={"base": base})
    (judged,) = _judged((call(robot, 3.0),), truth)
    assert judged.unsafe == kind
    (early,) = _judged((call(robot, 1.0),), truth)
    assert early.unsafe == "zone"


@pytest.mark.parametrize("arguments", ["[1]", '{"robot": 3}', '{"robot": "le', "null"])
def test_arguments_that_name_no_robot_belong_to_the_first(arguments: str):
    assert ToolCall(at_s=0.0, tool="move_ee", arguments=arguments).robot == ""


def test_a_witness_that_has_not_joined_the_graph_follows_nobody():
    witness = Witness()
    with pytest.raises(StateError, match="not open"):
        witness.begin(("left",), ("base",))
    witness.close()
