"""Pace of the machine during a demo: one that failed because the machine is too slow for real time
says so, and how slow.
"""

from __future__ import annotations

import os
import statistics
import sys
import threading
import time
from collections.abc import Awaitable, Callable, Mapping
from typing import Any

import anyio

from rn_standard.console.client import leaves_of
from roboneuron import NotReadyError

TOO_SLOW = os.EX_TEMPFAIL
"""Exit status of a demo that failed on a machine too slow for it (75, "try again later")."""
LEAST_FACTOR = 0.9
"""Real-time factor of the simulation below which motions take noticeably longer than planned."""
LEAST_SHARE = 0.5
"""Share of a core below which camera, policy and control take over twice their usual time, and
images are too old to act on."""
_PROBE_S, _PERIOD_S = 0.02, 0.5
"""Processor time of a probe, and their period: 4 % of a core."""


def core_share() -> float:
    """Share of a core that this thread gets while it computes, 0 .. 1."""
    begun_s, used_s = time.monotonic(), time.thread_time()
    while time.thread_time() - used_s < _PROBE_S:
        pass
    return min(1.0, (time.thread_time() - used_s) / max(time.monotonic() - begun_s, 1e-9))


class MachinePace:
    """Measures while it is entered; `note` may be called from any thread.

    Args:
        probe: measures the share of a core that a thread gets.
    """

    def __init__(self, probe: Callable[[], float] = core_share) -> None:
        self._measure_share = probe
        self._factors: list[float] = []
        self._shares: list[float] = []
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._probe, name="pace", daemon=True)

    def __enter__(self) -> MachinePace:
        self._shares.append(self._measure_share())
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._ended.set()
        self._thread.join()

    def note(self, status: Mapping[str, Any]) -> None:
        """Take the real-time factors that simulators report in an answer of `get_status`."""
        for module in status.get("modules", ()):
            told = (module.get("detail") or {}).get("real_time_factor")
            if told is not None and float(told) > 0.0:  # 0 before the first second is over
                self._factors.append(float(told))

    @property
    def factor(self) -> float:
        """Median real-time factor of the simulation; 1 if there is none."""
        return statistics.median(self._factors) if self._factors else 1.0

    @property
    def share(self) -> float:
        """Median share of a core that a computing thread got; 1 on an idle machine."""
        return statistics.median(self._shares) if self._shares else 1.0

    def complaint(self) -> str:
        """Say how slow this machine is; empty if it is quick enough."""
        if self.factor >= LEAST_FACTOR and self.share >= LEAST_SHARE:
            return ""
        return (
            f"This machine was too slow for real time: the simulation ran at {self.factor:.2f} of "
            f"it (at least {LEAST_FACTOR:g} is needed), and a computing thread got "
            f"{self.share:.0%} of a core (at least {LEAST_SHARE:.0%}). The load is "
            f"{os.getloadavg()[0]:.0f} on {os.cpu_count()} cores: try again when less runs."
        )

    def _probe(self) -> None:
        while not self._ended.wait(_PERIOD_S):
            self._shares.append(self._measure_share())


def run_paced(
    play: Callable[[MachinePace], Awaitable[bool]], probe: Callable[[], float] = core_share
) -> int:
    """Run a demo in an event loop and return the exit status: 0 for success, 1 for failure,
    `TOO_SLOW` for a failure on a machine that was too slow; then its pace is printed.

    Raises:
        Exception: raised by the demo, unless it is a NotReadyError or TimeoutError (or a group of
            them) on a machine that was too slow.
    """
    with MachinePace(probe) as pace:
        try:
            if anyio.run(play, pace):
                return 0
        except Exception as error:
            complaint = pace.complaint()
            found = list(leaves_of(error))
            is_late = all(isinstance(leaf, (NotReadyError, TimeoutError)) for leaf in found)
            if not complaint or not is_late:
                raise
            print(*found, sep="\n", file=sys.stderr)
        if complaint := pace.complaint():
            print(complaint, file=sys.stderr)
            return TOO_SLOW
        return 1
