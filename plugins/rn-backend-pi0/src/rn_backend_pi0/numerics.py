"""Numerical differences between the two public implementations of pi0: flow times, and the eps of
z-scores.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rn_backend_pi0.checkpoint import Family
from rn_backend_pi0.statistics import Quantiles, Scaling


def flow_times(family: Family, steps: int) -> tuple[float, ...]:
    """Times of `steps` Euler steps from 1 towards 0, exactly as the family's code rounds them to
    float32.

    The highest frequency of the time embedding is 1571 rad, so a rounding of 1e-7 in time is 2e-4
    in the embedding. Source: openpi subtracts 1/steps repeatedly in float32; LeRobot computes
    1 - k/steps and then rounds.
    """
    if family == "lerobot":
        return tuple(float(np.float32(1.0 + k * (-1.0 / steps))) for k in range(steps))
    times, time, step = [], np.float32(1.0), np.float32(-1.0 / steps)
    for _ in range(steps):
        times.append(float(time))
        time = np.float32(time + step)
    return tuple(times)


def with_eps(score: Scaling, family: Family) -> Scaling:
    """The same statistics with the family's eps.

    Source: openpi adds 1e-6 to the standard deviation or range both ways; LeRobot 1e-8 to the
    standard deviation when it divides, nothing on the way back and nothing to a range.
    """
    if isinstance(score, Quantiles):
        return replace(score, eps=1e-6 if family == "openpi" else 0.0)
    if family == "openpi":
        return replace(score, forward_eps=1e-6, backward_eps=1e-6)
    return replace(score, forward_eps=1e-8, backward_eps=0.0)
