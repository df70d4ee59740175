"""Calls that a computed or simulated arm carries out in place of the robot's."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, Protocol

from roboneuron.contract import F64, ControlSpace, JointSample, Pose
from roboneuron.server.tool import CallContext

__all__ = ["Rehearsable", "Rehearsal"]
"""Names that other distributions may use."""


class DrivenArm(Protocol):
    """What carries out rows, of a robot that is computed or simulated.

    Attributes:
        held: why the newest row was not carried out; empty when it was, shortened or not.
    """

    held: str

    def poses(self) -> tuple[Pose, ...]:
        """TCP pose of each arm in the base frame. Raises UnsafeError."""

    def follow(self, space: ControlSpace, row: F64, step_s: float) -> None:
        """Carry out a row of a space for `step_s`, as far as the limits allow."""


class RehearsedArm(DrivenArm, Protocol):
    """An arm of a twin."""

    def joints(self) -> JointSample:
        """What the twin measures."""

    def settle(self) -> None:
        """Let the arm come to rest where it is."""


class Rehearsal(Protocol):
    """One simulation in which calls follow each other; used from one thread."""

    @property
    def arm(self) -> RehearsedArm:
        """The arm, where the call before has left it."""

    @property
    def context(self) -> CallContext:
        """Of the call; its `run` works on this thread."""

    @property
    def namespace(self) -> str:
        """ROS namespace of the robot."""

    def check(self, messages: Sequence[object]) -> None:
        """Judge joint trajectories, one after the other, as the gate does. Raises RefusedError."""

    def play(self, messages: Sequence[object]) -> None:
        """Carry out joint trajectories. Raises as `check`."""


Needs = frozenset[Literal["control", "scene"]]


class Rehearsable(Protocol):
    """The handler of a tool whose `simulated_by` names the twin.

    Attributes:
        rehearsal_needs: "control" if the call itself needs it to run, "scene" if the twin must know
            what stands where.
    """

    rehearsal_needs: Needs

    def rehearse(self, arguments: Any, rehearsal: Rehearsal) -> None:
        """Have the twin carry out a call, instead of the robot.

        Raises:
            RefusedError: before its first motion the call would be refused, after it the arm does
                not get to the end.
            StateError: the hand holds nothing after it has moved.
            RoboNeuronError: as the handler, for a call that makes no sense.
        """
