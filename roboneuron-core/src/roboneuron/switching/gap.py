"""Gap in a module's outputs during a switch."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

_RECENT = 20


@dataclass(frozen=True, kw_only=True, slots=True)
class Gap:
    """Effect of a switch on the outputs.

    Attributes:
        gap_s: from the last output of the old module to the first of the new one.
        period_s: median time between the old module's last outputs.
    """

    gap_s: float
    period_s: float

    @property
    def missed(self) -> int:
        """Number of outputs missing from the old module's rhythm; half a period late is still in
        rhythm.
        """
        return max(0, round(self.gap_s / self.period_s) - 1)


def action_gap(sent_ns: Sequence[int], first_ns: int) -> Gap | None:
    """The gap before the action sent at `first_ns` [ns] or right after it; None without two earlier
    actions.
    """
    before = [at for at in sent_ns if at < first_ns][-_RECENT:]
    first = next((at for at in sent_ns if at >= first_ns), None)
    if len(before) < 2 or first is None:
        return None
    period_ns = statistics.median(b - a for a, b in pairwise(before))
    return Gap(gap_s=(first - before[-1]) / 1e9, period_s=max(1e-6, period_ns / 1e9))
