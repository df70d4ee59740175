"""A suite observes an arm that has no gripper, or one that is not measured, without an opening."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import replace

import pytest

from rn_eval.contract_cases import SuiteCase, cubes_case, hand_over_case
from roboneuron import GripperProfile

ELSEWHERE = GripperProfile(joint="a_joint_of_another_hand", closed_position=0.0, open_position=1.0)
Change = Callable[[GripperProfile | None], GripperProfile | None]
CHANGES: dict[str, tuple[Change, bool]] = {
    "as it is": (lambda gripper: gripper, True),
    "none": (lambda gripper: None, False),
    "not measured": (lambda gripper: ELSEWHERE, False),
}


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("case", [cubes_case(), hand_over_case()], ids=["one arm", "two arms"])
def test_an_arm_is_observed_without_its_gripper(case: SuiteCase, change: str) -> None:
    to_other, is_measured = CHANGES[change]
    setup = case.make_setup()
    profile = replace(setup.profile, gripper=to_other(setup.profile.gripper))
    if profile.arms:
        first = replace(profile.arms[0], gripper=to_other(profile.arms[0].gripper))
        profile = replace(profile, arms=(first, *profile.arms[1:]))
    suite = case.build()
    (episode,) = suite.episodes(1, 3)
    with closing(suite.open(episode, replace(setup, profile=profile))) as scene:
        seen = scene.observe(1)
    assert (seen.gripper_open is not None) is is_measured
    assert all(seen.arms[arm.name].gripper_open is not None for arm in profile.arms[1:])
