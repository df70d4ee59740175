"""Fault injection of an episode: when the fault is caused, and the time until the arm moves
again.
"""

from __future__ import annotations

import numpy as np

from rn_eval.agents.tap import ServerTap, end_module, module_pid
from rn_eval.agents.task import InjectedFault
from rn_eval.agents.truth import STILL_RAD_S, Truth


class Breakage:
    """Injects one fault; polled by the thread that runs the episode.

    Attributes:
        caused_s: time of the fault since the agent's start [s]; None before.
        restarted_s: time at which the module first had a new process [s]; None before.
    """

    def __init__(self, fault: InjectedFault | None) -> None:
        """`fault` is None in an episode without one."""
        self._fault = fault
        self._broken: int | None = None
        self.caused_s: float | None = None
        self.restarted_s: float | None = None

    def look(self, tap: ServerTap) -> None:
        """Cause the fault when it is due, and record when the module is back."""
        fault = self._fault
        if fault is None or self.restarted_s is not None:
            return
        pid = module_pid(tap.pid, fault.module)
        if self.caused_s is not None:
            if pid is not None and pid != self._broken:
                self.restarted_s = tap.now_s()
            return
        called_s = tap.first_call_s(fault.after_tool)
        if called_s is None or tap.now_s() < called_s + fault.delay_s:
            return
        if pid is not None:  # otherwise it is not started yet, or restarting
            self._broken, self.caused_s = pid, tap.now_s()
            end_module(pid, fault.kind)

    def recovery_s(self, truth: Truth) -> float | None:
        """Time from the fault until the arm moved with the module's new process [s]; None if that
        never happened.
        """
        if self.caused_s is None or self.restarted_s is None:
            return None
        moves = (truth.speeds_rad_s() > STILL_RAD_S) & (truth.t_s >= self.restarted_s)
        found = np.flatnonzero(moves)
        return round(float(truth.t_s[found[0]]) - self.caused_s, 2) if found.size else None
