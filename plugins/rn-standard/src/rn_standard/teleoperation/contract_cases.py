"""Contract of teleoperators, and the cases of those in this package; loaded only by the contract
kit and by tests.

Third parties test their own with `contract_of(TeleoperatorSpec)` and a `TeleoperatorCase`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar, cast

import numpy as np

from rn_standard.teleoperation.hooks import GIVES, TeleoperatorSpec
from rn_standard.teleoperation.plugin import TELEOPERATORS
from rn_standard.teleoperation.samples import LeadSample, Teleoperator
from rn_testing.case import Case
from rn_testing.fakes import MemoryTopics, gantry_profile
from rn_testing.kinds import Kind
from rn_testing.lifecycle import ALONE, PURE, check_pure_constructor
from rn_testing.process_state import find_changes
from rn_testing.rule import NotApplicable, Rule, require
from rn_testing.rules import OF_EVERY_DESCRIPTOR
from roboneuron import RobotProfile

M = TypeVar("M")
READ_S = 0.05
"""Tolerance of a read's timeout: the arm is held 0.1 s after the last sample."""
_WAIT_S, _SOON_S = 0.05, 2.0


class Loopback:
    """`Subscribe` for a case: passes messages to the subscribers."""

    def __init__(self) -> None:
        self._callbacks: dict[str, list[Callable[[Any], None]]] = {}

    def __call__(
        self, message_type: type[M], topic: str, callback: Callable[[M], None]
    ) -> Callable[[], None]:
        heard = self._callbacks.setdefault(topic, [])
        heard.append(callback)
        return lambda: heard.remove(callback)

    def publish(self, topic: str, message: object) -> None:
        """Pass a message to all subscribers."""
        for callback in list(self._callbacks.get(topic, ())):
            callback(message)

    @property
    def is_heard(self) -> bool:
        """True if there is a subscriber."""
        return any(self._callbacks.values())


Act = Callable[[Loopback, bool], None]
"""Simulates a person on the device or topic: holds the switch and moves, or releases it."""


@dataclass(frozen=True, kw_only=True)
class TeleoperatorCase(Case[TeleoperatorSpec]):
    """A teleoperator to be tested.

    Attributes:
        act: see `Act`; None without a device.
        profile: profile of the led robot.
    """

    subject: ClassVar[str] = "teleoperator"

    act: Act | None = None
    profile: Callable[[], RobotProfile] = gantry_profile

    def arguments(self) -> tuple[tuple[object, ...], dict[str, object]]:
        """Arguments as in a lead."""
        return (None, None), {}

    def inputs(self, topics: MemoryTopics) -> tuple[tuple[object, ...], dict[str, object]]:
        """The profile."""
        return (self.profile(),), {}

    def build(self) -> Teleoperator:
        """Create a new teleoperator."""
        return cast("Teleoperator", self.prepare()())

    def samples(self, *held: bool) -> list[LeadSample]:
        """Samples after each act. Raises NotApplicable without a device."""
        if self.act is None:
            raise NotApplicable("the case has no device")
        source, world = self.build(), Loopback()
        source.open(world)
        try:
            return [self._sample(source, world, is_held) for is_held in held]
        finally:
            source.close()

    def _sample(self, source: Teleoperator, world: Loopback, is_held: bool) -> LeadSample:
        assert self.act is not None
        deadline_s = time.monotonic() + _SOON_S
        while time.monotonic() < deadline_s:
            self.act(world, is_held)
            sample = source.read(_WAIT_S)
            if sample is not None and sample.is_held is is_held:
                return sample
        require(False, f"no sample came whose switch is {'held' if is_held else 'released'}")
        raise AssertionError


def _check_methods(case: TeleoperatorCase) -> None:
    made = case.build()
    missing = [name for name in ("open", "read", "close") if not callable(getattr(made, name, 0))]
    require(not missing, f"{type(made).__name__} lacks {', '.join(missing)}")


def _check_gives(case: TeleoperatorCase) -> None:
    require(case.spec.gives in GIVES, f"`gives` is {case.spec.gives!r}, not one of {GIVES}")
    require(30.0 <= case.spec.rate_hz <= 100.0, f"rate_hz is {case.spec.rate_hz}, not 30 .. 100")
    (sample,) = case.samples(True)
    found = {
        "twist": sample.twist is not None,
        "joint_velocity": bool(sample.velocities),
        "joint_position": bool(sample.positions),
    }
    given = [name for name, is_there in found.items() if is_there]
    require(given == [case.spec.gives], f"a sample has {given}, declared is {case.spec.gives}")
    if sample.twist is not None:
        is_right = sample.twist.shape == (6,) and sample.twist.dtype == np.float64
        require(is_right, f"a twist is {sample.twist!r}, expected float64 (6,)")


def _check_released(case: TeleoperatorCase) -> None:
    released, held = case.samples(False, True)
    require(released.number < held.number, "numbers do not increase")


def _check_clock(case: TeleoperatorCase) -> None:
    before_s = time.monotonic()
    first, second = case.samples(True, True)
    now_s = time.monotonic()
    require(
        before_s <= first.at_s <= second.at_s <= now_s,
        f"samples of {before_s:.3f} .. {now_s:.3f} s are of {first.at_s:.3f}, {second.at_s:.3f} s",
    )


def _check_bounded(case: TeleoperatorCase) -> None:
    if case.act is None:
        raise NotApplicable("the case has no device")
    source = case.build()
    source.open(Loopback())
    try:
        began_s = time.monotonic()
        quickest = min(_timed(source) for _ in range(3))
    finally:
        source.close()
    require(
        quickest <= _WAIT_S + READ_S, f"read({_WAIT_S}) took {quickest:.3f} s, from {began_s:.1f}"
    )


def _timed(source: Teleoperator) -> float:
    began_s = time.monotonic()
    source.read(_WAIT_S)
    return time.monotonic() - began_s


def _check_closed(case: TeleoperatorCase) -> None:
    source, world = case.build(), Loopback()
    source.close()
    if case.act is not None:
        source.open(world)
    source.close()
    source.close()
    require(not world.is_heard, "a topic is still subscribed to after close()")


def _check_process(case: TeleoperatorCase) -> None:
    changes = find_changes(lambda: case.build().close())
    require(not changes, f"constructor and close changed {', '.join(changes)}")


_OWN: tuple[Rule[TeleoperatorCase], ...] = tuple(
    Rule(
        id=f"teleoperator/{name}",
        text=text,
        source="rn_standard.teleoperation.samples.Teleoperator",
        check=check,
    )
    for name, text, check in (
        ("protocol", "It has the methods of Teleoperator.", _check_methods),
        ("constructor-pure", PURE, check_pure_constructor),
        ("process-left-alone", ALONE, _check_process),
        ("gives-what-it-declares", "A sample has what `gives` says, and no more.", _check_gives),
        ("switch-is-told", "It tells a switch that is released from one held.", _check_released),
        ("clock-is-ours", "Samples are of monotonic time, and do not go back.", _check_clock),
        ("read-is-bounded", "`read` returns within its time-out and 50 ms.", _check_bounded),
        ("close-releases", "`close` may come twice and before `open`.", _check_closed),
    )
)
RULES: tuple[Rule[TeleoperatorCase], ...] = (
    *cast("tuple[Rule[TeleoperatorCase], ...]", OF_EVERY_DESCRIPTOR),
    *_OWN,
)
"""Rules of a teleoperator: those of every descriptor, and its own."""
KIND = Kind(case=TeleoperatorCase, rules=RULES)
"""Parts that the kit needs to test teleoperators."""


def _spec(name: str) -> TeleoperatorSpec:
    return next(spec for spec in TELEOPERATORS if spec.name == name)


def twist_case() -> TeleoperatorCase:
    """Case of twists on a topic."""

    def act(world: Loopback, is_held: bool) -> None:
        from geometry_msgs.msg import TwistStamped  # heavy

        message = TwistStamped()
        message.twist.linear.x = 0.1 if is_held else 0.0
        world.publish("/lead/twist", message)

    return TeleoperatorCase(spec=_spec("twist-topic"), act=act)


def joint_case() -> TeleoperatorCase:
    """Case of a leader's joints with a switch."""

    def act(world: Loopback, is_held: bool) -> None:
        from sensor_msgs.msg import JointState  # heavy
        from std_msgs.msg import Bool  # heavy

        names = list(gantry_profile().arm_joints)
        world.publish("/leader/switch", Bool(data=is_held))
        world.publish("/leader/joint_states", JointState(name=names, position=[0.1] * len(names)))

    return TeleoperatorCase(spec=_spec("joint-topic"), act=act)


def spacemouse_case() -> TeleoperatorCase:
    """Case without a device; the tests of this package replace it by a file."""
    return TeleoperatorCase(spec=_spec("spacemouse"))


CASES: tuple[Callable[[], TeleoperatorCase], ...] = (twist_case, joint_case, spacemouse_case)
"""Cases of this package's teleoperators."""
