"""What a teleoperator gives, and what it is."""

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
    """What the person asks for at one moment; one of `twist`, `velocities` and `positions`.

    Attributes:
        number: greater than that of the sample before.
        at_s: when it was measured [monotonic s].
        is_held: the dead-man's switch is held; without it nothing moves.
        twist: float64 (6,) of the TCP: x y z [m/s], rotation [rad/s], right-handed.
        frame: of `twist`: the robot's base, or the TCP.
        velocities: by joint [rad/s, m/s of slides]; others stand still.
        positions: by joint, every joint of the arm [rad, m].
        gripper_open: 0 closed .. 1 open; None: as it is.
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
    """What became of a sample.

    Attributes:
        number: of the sample.
        who: who moves the arm: "person", "blend", "policy" or "nobody".
        limits: which limits act; empty for none.
        note: why the arm does not move as asked, and what to do; empty when it does.
        delay_s: from `LeadSample.at_s` to the arrival of control's answer, which follows the joint
            command [s].
    """

    number: int
    who: str
    limits: str
    note: str
    delay_s: float


class Subscribe(Protocol):
    """Calls back with each message of a topic until what is returned is called; see
    `Host.subscribe`.
    """

    def __call__(
        self, message_type: type[M], topic: str, callback: Callable[[M], None]
    ) -> Callable[[], None]: ...


class Teleoperator(Protocol):
    """A source of samples. Built as `target(config, profile)`; used from one thread, for one lead.

    The constructor has no effect.
    """

    def open(self, subscribe: Subscribe) -> None:
        """Open the device, or listen to the topic.

        Raises:
            RoboNeuronError: it cannot be opened; says what to do.
        """
        ...

    def read(self, timeout_s: float) -> LeadSample | None:
        """The newest sample that was not read yet; None when none came within `timeout_s`.

        Raises:
            RoboNeuronError: the device is lost, or has sent what it must not; the lead ends.
        """
        ...

    def close(self) -> None:
        """Release everything; idempotent, also before `open`."""
        ...


@runtime_checkable
class ToldTeleoperator(Protocol):
    """What a teleoperator may offer besides: it shows what its samples do."""

    def tell(self, feedback: LeadFeedback) -> None:
        """Called from the thread of the ROS node; returns at once."""
        ...

    def ended(self, reason: str) -> None:
        """The lead is over; `reason` says why and what to do, empty when it was handed back."""
        ...
