"""Evaluation of predicates: true, false or undecided, each with its reason."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from rn_standard.tasks.monitor import Monitor, Score
from rn_standard.tasks.predicates import (
    All,
    AnyOf,
    FieldIs,
    GripperHolds,
    Held,
    JointsIn,
    MonitorSays,
    Not,
    PolicyDone,
    Predicate,
    Still,
    TcpIn,
    flat,
)
from rn_standard.tasks.snapshot import Snapshot
from roboneuron.direct_path.fields import read_value

MonitorFor = Callable[[MonitorSays], Monitor]
"""Builds the monitor named by a predicate."""
GRIPPER_STILL_S, _GRIPPER_MOVED = 0.2, 0.04
"""Time and tolerance for a gripper at rest: a moving gripper passes every opening, so only a
resting one can hold an object; the tolerance covers measurement noise.
"""
_MOST_TEXT = 120
"""Maximum length of a quoted value in a reason [characters]."""


@dataclass(frozen=True, kw_only=True, slots=True)
class PredicateState:
    """Result of an evaluation.

    Attributes:
        value: None if it cannot be decided.
        reason: one sentence, without its full stop.
    """

    value: bool | None
    reason: str


class PredicateJudge:
    """Evaluates one predicate during a task; stores the state of time-dependent predicates. Used
    from one thread.

    Args:
        predicate: the predicate.
        instruction: part of the observations for monitors.
        monitor_for: builds monitors; called once for each named monitor.
        gripper_joints: name of the gripper's joint of each arm by its name ("" for the only or
            first), for its effort.

    Attributes:
        lasts_s: longest time for which a part of the predicate has to be true [s].
    """

    def __init__(
        self,
        predicate: Predicate,
        instruction: str,
        monitor_for: MonitorFor,
        gripper_joints: Mapping[str, str] | None = None,
    ) -> None:
        self._root = predicate
        self._instruction = instruction
        self._gripper_joints = gripper_joints or {}
        self._monitors: dict[int, Monitor] = {}
        self._scores: dict[int, tuple[Mapping[str, int], Score]] = {}
        self._true_since_s: dict[int, float] = {}
        # for each arm in a predicate: the opening at which it came to rest, and when
        self._openings = {
            part.arm: (-1.0, 0.0) for part in flat(predicate) if isinstance(part, GripperHolds)
        }
        self._is_lenient = False
        self.lasts_s = max(
            (part.for_s for part in flat(predicate) if isinstance(part, Held | Still)), default=0.0
        )
        self._collect(predicate, monitor_for)

    def reset(self, snapshot: Snapshot) -> None:
        """Begin an attempt with the initial state."""
        self._true_since_s.clear()
        self._scores.clear()
        self._openings = dict.fromkeys(self._openings, (-1.0, snapshot.now_s))
        observation = snapshot.observation(self._instruction)
        for monitor in self._monitors.values():
            monitor.reset(observation)

    def look(self, snapshot: Snapshot) -> PredicateState:
        """Evaluate now; call it in the order of time."""
        for arm, (before, _) in self._openings.items():
            opening = snapshot.of_arm(arm).gripper_open
            if opening is not None and abs(opening - before) > _GRIPPER_MOVED:
                self._openings[arm] = (opening, snapshot.now_s)
        return self._judge(self._root, snapshot)

    def may_last(self, snapshot: Snapshot) -> bool:
        """True if only time is missing: the predicate would be true now without required
        durations.
        """
        self._is_lenient = True
        try:
            return self._judge(self._root, snapshot).value is True
        finally:
            self._is_lenient = False

    def _collect(self, predicate: Predicate, monitor_for: MonitorFor) -> None:
        if isinstance(predicate, MonitorSays):
            self._monitors[id(predicate)] = monitor_for(predicate)
        for part in predicate.parts():
            self._collect(part, monitor_for)

    def _judge(self, predicate: Predicate, snapshot: Snapshot) -> PredicateState:
        match predicate:
            case All():
                return _all([self._judge(part, snapshot) for part in predicate.of])
            case AnyOf():
                return _negated(
                    _all([_negated(self._judge(part, snapshot)) for part in predicate.of])
                )
            case Not():
                return _negated(self._judge(predicate.of, snapshot))
            case Held():
                return self._held(predicate, snapshot)
            case FieldIs():
                return _field(predicate, snapshot.messages.get(predicate.topic))
            case TcpIn():
                return _tcp(predicate, snapshot)
            case JointsIn():
                return _joints(predicate, snapshot.joints)
            case GripperHolds():
                return self._gripper(predicate, snapshot)
            case Still():
                if snapshot.still_s is None:
                    return PredicateState(value=None, reason="the joints are not measured")
                reason = f"no joint has moved for {snapshot.still_s:.1f} s"
                return PredicateState(
                    value=self._is_lenient or snapshot.still_s >= predicate.for_s, reason=reason
                )
            case PolicyDone():
                if snapshot.policy_done is None:
                    return PredicateState(
                        value=None, reason="the policy does not say whether it has finished"
                    )
                said = "has" if snapshot.policy_done else "has not"
                return PredicateState(
                    value=snapshot.policy_done, reason=f"the policy says that it {said} finished"
                )
            case MonitorSays():
                return self._monitor(predicate, snapshot)

    def _held(self, predicate: Held, snapshot: Snapshot) -> PredicateState:
        inner = self._judge(predicate.of, snapshot)
        if self._is_lenient:
            return inner
        if inner.value is not True:
            self._true_since_s.pop(id(predicate), None)
            return inner
        held_s = snapshot.now_s - self._true_since_s.setdefault(id(predicate), snapshot.now_s)
        return PredicateState(
            value=held_s >= predicate.for_s, reason=f"{inner.reason}, for {held_s:.1f} s"
        )

    def _gripper(self, predicate: GripperHolds, snapshot: Snapshot) -> PredicateState:
        opening = snapshot.of_arm(predicate.arm).gripper_open
        if opening is None:
            return PredicateState(value=None, reason="the opening of the gripper is not measured")
        if not predicate.least_open <= opening <= predicate.most_open:
            where = "closed on nothing" if opening < predicate.least_open else "open"
            return PredicateState(value=False, reason=f"the gripper is {where} ({opening:.2f})")
        if (
            snapshot.now_s - self._openings[predicate.arm][1] < GRIPPER_STILL_S
            and not self._is_lenient
        ):
            return PredicateState(value=False, reason=f"the gripper is moving ({opening:.2f})")
        reason = f"the gripper stands at {opening:.2f}"
        if predicate.least_effort is not None:
            effort = snapshot.effort.get(self._gripper_joints.get(predicate.arm, ""))
            if effort is None:
                return PredicateState(
                    value=None, reason=f"{reason}, and its effort is not measured"
                )
            reason += f" with an effort of {abs(effort):.1f}"
            return PredicateState(value=abs(effort) >= predicate.least_effort, reason=reason)
        return PredicateState(value=True, reason=reason)

    def _monitor(self, predicate: MonitorSays, snapshot: Snapshot) -> PredicateState:
        stamps = {role: frame.stamp_ns for role, frame in snapshot.frames.items()}
        known = self._scores.get(id(predicate))
        if known is None or not stamps or known[0] != stamps:
            # Once for each set of images: the pose measured at their arrival fits them better than
            # a later one.
            score = self._monitors[id(predicate)].score(snapshot.observation(self._instruction))
            known = self._scores[id(predicate)] = (stamps, score)
        score = known[1]
        value = None if score.value is None else score.value >= predicate.at_least
        told = "" if score.value is None else f" ({score.value:.2f})"
        return PredicateState(value=value, reason=f"{predicate.name}: {score.reason}{told}")


def _all(parts: list[PredicateState]) -> PredicateState:
    """False if one part is false, else undecided if one is, else true."""
    for value in (False, None):
        found = [part.reason for part in parts if part.value is value]
        if found:
            return PredicateState(value=value, reason="; ".join(found))
    return PredicateState(value=True, reason="; ".join(part.reason for part in parts))


def _negated(judgement: PredicateState) -> PredicateState:
    value = None if judgement.value is None else not judgement.value
    return PredicateState(value=value, reason=judgement.reason)


def _tcp(predicate: TcpIn, snapshot: Snapshot) -> PredicateState:
    tcp = snapshot.of_arm(predicate.arm).tcp
    if tcp is None:
        return PredicateState(value=None, reason="the pose of the TCP is not measured")
    place = tcp.position_m.tolist()
    inside = all(
        low <= value <= high
        for low, value, high in zip(predicate.lower_m, place, predicate.upper_m, strict=True)
    )
    told = ", ".join(f"{value:.3f}" for value in place)
    return PredicateState(value=inside, reason=f"the TCP is at [{told}] m")


def _joints(predicate: JointsIn, joints: Mapping[str, float] | None) -> PredicateState:
    missing = [name for name in predicate.joints if joints is None or name not in joints]
    if joints is None or missing:
        return PredicateState(value=None, reason=f"{', '.join(missing)} is not measured")
    outside = [
        name for name, (low, high) in predicate.joints.items() if not low <= joints[name] <= high
    ]
    told = ", ".join(f"{name} {joints[name]:.3f}" for name in outside or predicate.joints)
    return PredicateState(
        value=not outside, reason=f"{told} {'outside' if outside else 'inside'} the range"
    )


def _field(predicate: FieldIs, message: object) -> PredicateState:
    place = f"{predicate.field} of {predicate.topic}"
    if message is None:
        return PredicateState(value=None, reason=f"no message on {predicate.topic}")
    try:
        value = read_value(message, predicate.field)
    except LookupError as error:
        return PredicateState(value=None, reason=str(error))
    if predicate.equals is not None:
        return PredicateState(
            value=bool(value == predicate.equals), reason=f"{place} is {_quoted(value)}"
        )
    if isinstance(value, bool) or not isinstance(value, int | float):
        return PredicateState(value=None, reason=f"{place} is {_quoted(value)}, no number")
    low, high = predicate.at_least, predicate.at_most
    inside = (low is None or value >= low) and (high is None or value <= high)
    return PredicateState(value=inside and value == value, reason=f"{place} is {value:g}")


def _quoted(value: object) -> str:
    text = repr(value)
    return text if len(text) <= _MOST_TEXT else f"{text[:_MOST_TEXT]} ..."
