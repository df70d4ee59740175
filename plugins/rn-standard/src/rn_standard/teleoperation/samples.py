"""Protocol of teleoperators, their samples and feedback."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal, Protocol, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
Frame = Literal["base", "tool"]
M = TypeVar("M")


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class LeadSample:
    """Command of the person at one moment; one of `twist`, `velocities` and `positions`.

    Attributes:
        number: greater than that of the previous sample.
        at_s: time of measurement [monotonic s].
        is_held: the dead-man's switch is held; otherwise nothing moves.
        twist: float64 (6,) of the TCP: x y z [m/s], rotation [rad/s], right-handed.
        frame: frame of `twist`: the robot's base, or the TCP.
        velocities: by joint [rad/s, m/s of slides]; others stand still.
        positions: by joint, every joint of the arm [rad, m].
        gripper_open: 0 closed .. 1 open; None for no change.
    """

    number: int
    at_s: float
    is_held: bool
    twist: F64 | None = None
    frame: Frame = "base"
    velocities: Mapping[str, float] = field(default_factory=dict)
    positions: Mapping[str, float] = field(default_factory=dict)
    gripper_open: float | None = None


@dataclass(frozen=True, kw_only=True, slots=True)
class LeadFeedback:
    """Result of a sample.

    Attributes:
        number: number of the sample.
        who: source that moves the arm: "person", "blend", "policy" or "nobody".
        limits: limits that act; empty for none.
        note: reason why the arm does not follow, with a remedy; empty if it follows.
        delay_s: from `LeadSample.at_s` to the arrival of control's answer, which follows the joint
            command [s].
    """

    number: int
    who: str
    limits: str
    note: str
    delay_s: float


class Subscribe(Protocol):
    """Subscribes to a topic; the returned function ends the subscription. See `Host.subscribe`."""

    def __call__(
        self, message_type: type[M], topic: str, callback: Callable[[M], None]
    ) -> Callable[[], None]: ...


class Teleoperator(Protocol):
    """A source of samples. Built as `target(config, profile)`; used from one thread, for one lead.

    The constructor has no side effect.
    """

    def open(self, subscribe: Subscribe) -> None:
        """Open the device, or subscribe to the topic.

        Raises:
            RoboNeuronError: it cannot be opened; names a remedy.
        """
        ...

    def read(self, timeout_s: float) -> LeadSample | None:
        """Return the newest unread sample; None if none came within `timeout_s`.

        Raises:
            RoboNeuronError: the device is lost, or has sent invalid data; the lead ends.
        """
        ...

    def close(self) -> None:
        """Release everything; idempotent, also before `open`."""
        ...


@runtime_checkable
class ToldTeleoperator(Protocol):
    """Optional interface of a teleoperator that displays the results of its samples."""

    def tell(self, feedback: LeadFeedback) -> None:
        """Process the result of a sample; called on the thread of the ROS node; returns at once."""
        ...

    def ended(self, reason: str) -> None:
        """Process the end of the lead; `reason` contains the cause and a remedy, empty after a
        hand-back.
        """
        ...
