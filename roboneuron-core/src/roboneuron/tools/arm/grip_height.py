"""Grip of an arm that remembers the height of the grasp, and what it holds."""

from __future__ import annotations

import logging

from roboneuron.errors import RoboNeuronError
from roboneuron.server.host import Host
from roboneuron.server.motion_gate import ExposedEndpoint, MotionGate
from roboneuron.sight.marks import told_name
from roboneuron.tools.arm.grip import Grip
from roboneuron.tools.arm.measured import MeasuredPose
from roboneuron.tools.arm.put_down import (
    HeldObject,
)

log = logging.getLogger(__name__)
_CLOSES = 0.05
"""Fraction of the travel: a smaller change of the commanded opening is not a grasp."""


class GripHeight(Grip):
    """Records the height of the TCP when the hand last closed, whatever command closed it.

    Attributes:
        held: what pick has grasped, until another command opens or closes the hand.
    """

    def __init__(
        self,
        host: Host,
        gate: MotionGate,
        exposed: ExposedEndpoint,
        tcp: MeasuredPose,
        arm: str = "",
    ) -> None:
        super().__init__(host, gate, exposed, arm)
        self._tcp = tcp
        self._opening: float | None = None
        self._closed_at_m: float | None = None
        self.held: HeldObject | None = None
        self._has_closed = False
        self._clock = host.clock(exposed.namespace)

    @property
    def closed_at_m(self) -> float | None:
        """Height of the TCP [m]; None if not observed."""
        told = self._clock.closed_at_m(self.arm)
        return self._closed_at_m if told is None else told

    @property
    def held_name(self) -> str:
        """What the hand holds, for sentences, when something blocks its fingers."""
        return "something" if self.held is None else told_name(self.held.object)

    def hold(self, held: HeldObject) -> None:
        """Remember what the hand, which was commanded to close, has grasped."""
        self._has_closed = False
        self.held = held

    def watch(self) -> None:
        """Start observing; does nothing the second time."""
        if self._note not in self._tcp.listeners:
            self._tcp.listeners.append(self._note)
        try:
            self._tcp.open()
        except RoboNeuronError as error:  # reported by the tools that need the pose
            log.warning("%s", error)

    def _note(self, height_m: float) -> None:
        """Process a pose: record its height if a smaller opening was commanded since the
        last one.
        """
        before, now = self._opening, self.commanded()
        self._opening = now
        if now is not None and now <= _CLOSES:
            self._has_closed = True  # the report of the opening comes later than the grasp is known
        elif now is not None and self._has_closed:
            self.held = None
        if now is not None and (1.0 if before is None else before) - now > _CLOSES:
            self._closed_at_m = height_m
