"""A teleoperator that pushes the arm to and fro, as a person would, for `lost_modules`."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence

import numpy as np

from rn_standard.teleoperation.hooks import TeleoperatorSpec
from rn_standard.teleoperation.samples import LeadSample, Subscribe
from roboneuron.plugins.hookspecs import hookimpl

RATE_HZ = 50.0
PRESSED_S = 0.3


class Push:
    """The switch is pressed after a moment, and held."""

    def __init__(self, config: object, profile: object) -> None:
        self._number, self._begun_s = 0, 0.0

    def open(self, subscribe: Subscribe) -> None:
        """Begin."""
        self._begun_s = time.monotonic()

    def read(self, timeout_s: float) -> LeadSample | None:
        """Return the next sample."""
        time.sleep(min(timeout_s, 0.8 / RATE_HZ))
        now_s = time.monotonic()
        self._number += 1
        passed_s = now_s - self._begun_s
        twist = np.zeros(6)
        twist[1] = 0.08 * math.cos(math.pi * passed_s)
        return LeadSample(
            number=self._number, at_s=now_s, is_held=passed_s > PRESSED_S, twist=twist
        )

    def close(self) -> None:
        """Nothing to release."""


@hookimpl
def roboneuron_teleoperators() -> Sequence[TeleoperatorSpec]:
    """The teleoperator."""
    return [
        TeleoperatorSpec(
            name="push", summary="Pushes to and fro", target="lost_plugin:Push", rate_hz=RATE_HZ
        )
    ]
