"""A grasp that fails once: the gripper opens while a cube is in the air, to test detection and
recovery.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from roboneuron import ConfigurationError

F64 = NDArray[np.float64]

SWITCH = "ROBONEURON_SIMULATOR_SLIP"
"""Environment variable: lift time of a cube [s] after which the gripper opens. Not a driver option,
because agents read the configuration and would be warned.
"""
GIVES_WAY_S = 0.25
"""Time for which the gripper opens; a cube falls out of fingers of 45 mm within 0.1 s."""
_GIVES_WAY_BY = 0.3
"""Share of the finger's travel by which the gripper opens, so that neither finger touches the
cube.
"""


def slips_after_s() -> float | None:
    """Lift time after which grasps of simulations in this process fail [s]; None for never.

    Raises:
        ConfigurationError: `SWITCH` is no positive number.
    """
    text = os.environ.get(SWITCH, "")
    if not text:
        return None
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0.0):
        raise ConfigurationError(
            f"{SWITCH} is {text!r}, expected seconds > 0.", hint="Unset it, or give a number."
        )
    return value


class Slip:
    """Opens every gripper of a cell once, and closes it again. Used from one thread.

    Args:
        after_s: lift time of a cube after which it opens [s].
        fingers: indices of the finger joints in the order of the cell's `joints`.
        closed, opened: position of each of `fingers` [rad or m].
    """

    def __init__(self, after_s: float, fingers: Sequence[int], closed: F64, opened: F64) -> None:
        self._after_s, self._fingers = after_s, list(fingers)
        self._closed, self._opened = closed, opened
        self._until_s: float | None = None
        self._aim = opened

    def notice(self, now_s: float, lifted_s: float, measured: F64) -> None:
        """Report that a cube has been lifted for `lifted_s` at `now_s`, with the joints at
        `measured`.
        """
        if self._until_s is None and lifted_s >= self._after_s:
            self._until_s = now_s + GIVES_WAY_S
            wider = measured[self._fingers] + _GIVES_WAY_BY * (self._opened - self._closed)
            self._aim = np.clip(wider, self._closed, self._opened)

    def aimed(self, now_s: float, position: F64) -> F64:
        """Motor setpoints instead of `position` (n,) [rad, m]; unchanged unless slipping."""
        if self._until_s is None or now_s >= self._until_s:
            return position
        given = position.copy()
        given[self._fingers] = self._aim
        return given
