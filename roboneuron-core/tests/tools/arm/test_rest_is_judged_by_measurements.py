"""Joints rest if they were measured at one place for a tenth of a second: one measurement that is
read again shows nothing, because the robot may move while its states are late.
"""

from __future__ import annotations

import numpy as np
import pytest

from roboneuron.contract import JointKinds, JointSample
from roboneuron.tools.arm.joint_rest import JointRest

BEGAN_NS = 1_700_000_000_000_000_000
KINDS = JointKinds(urdf="")


def measured(position: float, after_ms: int | None) -> JointSample:
    """A measurement, `after_ms` None for one without a stamp."""
    stamp_ns = 0 if after_ms is None else BEGAN_NS + after_ms * 1_000_000
    return JointSample(names=("joint",), position=np.array([position]), stamp_ns=stamp_ns)


@pytest.mark.parametrize(
    ("samples", "rests"),
    [
        ([(0.0, 0), (0.0, 50), (0.0, 100)], True),
        ([(0.0, 0), (0.0, 50), (0.0, 99)], False),
        ([(0.0, 0)] * 50, False),
        ([(0.0, 0)] * 50 + [(0.1, 500)], False),
        ([(0.0, 0), (0.1, 500), (0.1, 600)], True),
        ([(0.0, None)] * 5, True),
        ([(0.0, None)] * 4, False),
    ],
    ids=[
        "still",
        "not long enough",
        "one that is read again",
        "late",
        "moved, then still",
        "without stamps",
        "without stamps, not long enough",
    ],
)
def test_rest_takes_a_tenth_of_a_second_of_measurements(
    samples: list[tuple[float, int | None]], rests: bool
) -> None:
    """Each is read 30 ms after the one before."""
    rest = JointRest(("joint",), KINDS)
    told = [
        rest.note(measured(*sample), 100.0 + 0.03 * number) for number, sample in enumerate(samples)
    ]
    assert told[-1] is rests
