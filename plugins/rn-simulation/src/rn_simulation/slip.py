"""A grasp that fails once: the hand gives way while a cube is in the air, for tests of what notices
and mends that.
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
"""Environment variable: seconds for which a cube has been lifted when the hand gives way. No option
of a driver: what agents read of the configuration would announce it.
"""
GIVES_WAY_S = 0.25
"""A cube between fingers of 45 mm has fallen out of them after 0.1 s."""
_GIVES_WAY_BY = 0.3
"""Share of the finger's travel by which the hand opens: the cube touches neither finger."""


def slips_after_s() -> float | None:
    """When grasps of simulations in this process fail; None where they do not.

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
    """Opens every hand of a cell once, by itself, and closes it again. Used from one thread.

    Args:
        after_s: for so long a cube has been lifted then [s].
        fingers: numbers of the finger joints in the order of the cell's `joints`.
        closed, opened: position of each of `fingers` [rad or m].
    """

    def __init__(self, after_s: float, fingers: Sequence[int], closed: F64, opened: F64) -> None:
        self._after_s, self._fingers = after_s, list(fingers)
        self._closed, self._opened = closed, opened
        self._until_s: float | None = None
        self._aim = opened

    def notice(self, now_s: float, lifted_s: float, measured: F64) -> None:
        """A cube has been lifted for `lifted_s` at `now_s`, the joints being at `measured`."""
        if self._until_s is None and lifted_s >= self._after_s:
            self._until_s = now_s + GIVES_WAY_S
            wider = measured[self._fingers] + _GIVES_WAY_BY * (self._opened - self._closed)
            self._aim = np.clip(wider, self._closed, self._opened)

    def aimed(self, now_s: float, position: F64) -> F64:
        """What the motors aim at instead of `position` (n,) [rad, m]; the same while all holds."""
        if self._until_s is None or now_s >= self._until_s:
            return position
        given = position.copy()
        given[self._fingers] = self._aim
        return given
