"""The joints of a simulated arm, watched from outside."""

from __future__ import annotations

import contextlib
import threading
import time
from typing import Any

import numpy as np

from rn_robot_fr3.fci.simulator import FrankaSim

STILL_RAD_S = 0.02
"""Velocity of a joint below which it stands."""


class Witness:
    """The joints of a simulation (7,) and their velocities, with the time of arrival [monotonic
    s].
    """

    def __init__(self) -> None:
        self.states: list[tuple[float, np.ndarray, np.ndarray]] = []

    def watch_topic(self, link: Any, robot: str) -> None:
        """Subscribe to the measurements of the simulation's driver."""
        from sensor_msgs.msg import JointState  # heavy

        from roboneuron.ros.qos import NEWEST  # heavy

        link.subscribe(JointState, f"/{robot}/joint_states", self._on_state, NEWEST)

    def _on_state(self, message: Any) -> None:
        self._add(message.position, message.velocity)

    def watch_simulator(self, sim: FrankaSim, end: threading.Event) -> None:
        """Query franka-sim itself until the event is set; runs on its own thread."""
        while not end.wait(0.015):
            with contextlib.suppress(OSError):
                told = sim.tell()
                self._add(told["joints"], told["velocities"])

    def _add(self, position: Any, velocity: Any) -> None:
        self.states.append((time.monotonic(), np.array(position[:7]), np.array(velocity[:7])))

    def is_still(self) -> bool:
        """True if the recent states of the last 0.3 s show no motion."""
        now_s = time.monotonic()
        recent = [np.abs(v).max() for at_s, _, v in self.states[-60:] if at_s > now_s - 0.3]
        return len(recent) > 8 and max(recent) < STILL_RAD_S

    def is_moving(self) -> bool:
        """True if the newest state shows motion."""
        return bool(self.states) and np.abs(self.states[-1][2]).max() > 3 * STILL_RAD_S

    def moved_rad(self, since_s: float) -> float:
        """Largest distance of any joint from its position at that time [rad]; a new simulation sets
        a new reference.
        """
        base, farthest, before_s = None, 0.0, since_s
        for at_s, position, _ in self.states:
            if at_s < since_s:
                continue
            # after a gap: another process, or a restarted one
            if base is None or at_s - before_s > 1.0:
                base = position
            before_s = at_s
            farthest = max(farthest, float(np.abs(position - base).max()))
        return farthest
