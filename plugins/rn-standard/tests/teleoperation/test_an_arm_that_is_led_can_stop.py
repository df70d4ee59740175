"""No joint is led faster than it can stop from in its share of the time to rest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rn_standard.teleoperation.braking import BRAKE_S, stoppable
from rn_testing.fakes import gantry_profile
from roboneuron import JointCommand, JointSample

PROFILE = gantry_profile()
ARM = PROFILE.arm_joints
PERIOD_S = 0.02
assert PROFILE.limits is not None
HARDEST = np.asarray(PROFILE.limits.acceleration)
START = np.full(len(ARM), 0.1)
JOINTS = JointSample(names=(*ARM, "finger"), position=np.append(START, 0.04), stamp_ns=0)


def command(change: np.ndarray) -> JointCommand:
    return JointCommand(
        names=("finger", *ARM), position=np.append(0.0, START + change), duration_s=PERIOD_S
    )


@pytest.mark.parametrize("times", [1.1, 5.0, -3.0])
def test_a_faster_command_is_shortened_in_its_direction(times: float) -> None:
    shares = np.linspace(0.2, 1.0, len(ARM))
    change = shares * HARDEST * BRAKE_S * PERIOD_S
    sent = stoppable(command(times * change), JOINTS, PROFILE)
    assert sent.position[1:] - START == pytest.approx(np.sign(times) * change)
    assert sent.position[0] == 0.0
    assert sent.duration_s == PERIOD_S


def test_a_slower_command_is_left_alone() -> None:
    asked = command(0.9 * HARDEST * BRAKE_S * PERIOD_S)
    assert stoppable(asked, JOINTS, PROFILE).position == pytest.approx(asked.position)


def test_a_robot_without_limits_is_not_slowed_down() -> None:
    asked = command(np.ones(len(ARM)))
    assert stoppable(asked, JOINTS, replace(PROFILE, limits=None)) is asked
