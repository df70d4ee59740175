"""The gate: every request of an agent passes it, and every decision is audited.

Order: allow list, role, type, finiteness, frame, bounds, steering, places, goals of a planner,
joint limits, path, emergency stop, rate, audit. The first violated rule refuses; a refused request
does not count against the rate. Refuse by default, clamp only if configured.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

from roboneuron import estop
from roboneuron.contract import JointSample
from roboneuron.direct_path.joint_messages import joint_commands
from roboneuron.direct_path.limits import MessageChecks, check_endpoint, check_steering
from roboneuron.direct_path.places import FindTransform, check_places, to_frame
from roboneuron.direct_path.plan_scenes import check_plans
from roboneuron.direct_path.plans import check_plan_only, constraints_to_frame, watch_of
from roboneuron.direct_path.rate import RateLimit
from roboneuron.direct_path.request import ROLE_BY_KIND, AllowedEndpoint
from roboneuron.errors import RefusedError, RoboNeuronError
from roboneuron.gate.audit import AuditLog, AuditRecord
from roboneuron.gate.motion import joint_space
from roboneuron.gate.motion.joint_paths import check_joints
from roboneuron.gate.motion.path_limits import Leg, LimitError
from roboneuron.gate.motion.path_watch import WayWatch
from roboneuron.server.motion_gate import ExposedEndpoint, GateRequest
from roboneuron.server.verdict import Clamp, Verdict

_Key = tuple[str, str]


@dataclass(frozen=True, kw_only=True, slots=True)
class _GatedEndpoint:
    """An endpoint of the allow list with its prepared checks."""

    allowed: AllowedEndpoint
    rate: RateLimit
    checks: MessageChecks


class Gate:
    """Decides on requests; safe from any thread.

    Attributes:
        latch: the emergency stop.
        audit: log of decisions.
        transforms: as given.
    """

    def __init__(
        self,
        allowed: Iterable[AllowedEndpoint],
        *,
        latch: estop.EmergencyStopLatch,
        audit: AuditLog,
        clock: Callable[[], float],
        simulated: bool = False,
        transforms: FindTransform | None = None,
    ) -> None:
        """Args:
        allowed: the allow list; nothing else is reachable.
        latch: the emergency stop, shared with every process.
        audit: log of decisions.
        clock: monotonic time [s], for rates.
        simulated: answer every request, but let none be sent.
        transforms: converts places to the frame of their endpoint; may block for a second. Without
            it, places in another frame are refused.

        Raises:
            ConfigurationError: an endpoint cannot be exposed.
        """
        self.latch = latch
        self.audit = audit
        self._clock = clock
        self._simulated = simulated
        self.transforms = transforms
        self._entries: dict[_Key, _GatedEndpoint] = {}
        self._rates: dict[tuple[str, ...], RateLimit] = {}
        self.replace(allowed)

    def replace(self, allowed: Iterable[AllowedEndpoint]) -> None:
        """Replace the allow list; rate counts of unchanged endpoints are kept.

        Raises:
            ConfigurationError: an endpoint cannot be exposed; the old list stays.
        """
        entries: dict[_Key, _GatedEndpoint] = {}
        rates: dict[tuple[str, ...], RateLimit] = {}
        for entry in allowed:
            endpoint = entry.endpoint
            check_endpoint(endpoint)
            # Two names of one topic are one stream of messages, to which the robot's rate applies.
            place = (
                (endpoint.kind, entry.topic)
                if entry.topic
                else (endpoint.kind, entry.robot, endpoint.name)
            )
            use = (*place, str(endpoint.rate_hz))
            if use not in rates:
                rates[use] = self._rates.get(use) or RateLimit(endpoint.rate_hz, self._clock)
            entries[entry.robot, endpoint.name] = _GatedEndpoint(
                allowed=entry, rate=rates[use], checks=MessageChecks(entry)
            )
        self._entries, self._rates = entries, rates

    def allowed(self) -> tuple[AllowedEndpoint, ...]:
        """The allow list."""
        return tuple(entry.allowed for entry in self._entries.values())

    def check(self, request: GateRequest) -> Verdict:
        """Decide, audit the decision, and return it; send only if `Verdict.may_send`.

        The messages of an allowed request may have been clamped, as listed in the verdict.

        Raises:
            RefusedError: refused. A simulated request gets an answer instead, with `allowed` false
                and the reason.
        """
        simulated = request.simulated or self._simulated
        verdict, cause = self._judge(request, simulated)
        self._write(request, verdict)
        if cause is not None and not simulated:
            raise cause
        return verdict

    def check_next(self, request: GateRequest) -> None:
        """Check one more message of an allowed motion; only a refusal is audited.

        Raises:
            RefusedError: refused; the motion has to end.
        """
        verdict, cause = self._judge(replace(request, repeated=True), self._simulated)
        if cause is not None:
            self._write(request, replace(verdict, simulated=False))
            raise cause

    def check_running(self) -> None:
        """Raise RefusedError if motion in progress has to end: latched, or the audit failed.

        Called before every step of a sequence and every repetition; about 1 us.
        """
        self.latch.check()
        if self.audit.failure is not None:
            raise self.audit.failure.refusal()

    def slowdown(self, request: GateRequest) -> float:
        """Factor, at least 1, by which the request's duration must grow to respect the TCP's speed
        limits.

        Raises:
            RefusedError: the path cannot be evaluated.
        """
        found = self._entries.get((request.robot, request.endpoint))
        if found is None or found.allowed.path is None or request.joints is None:
            return 1.0
        with _judging():
            return found.allowed.path().slowdown(_legs(found.allowed, request), request.joints)

    def joint_limits(self, exposed: ExposedEndpoint) -> Mapping[str, joint_space.JointLimit]:
        """As `MotionGate.joint_limits`."""
        found = self._entries.get((exposed.robot, exposed.endpoint.name))
        rules = None if found is None else found.allowed.rules
        assert exposed.profile is not None, "it has joints"
        return joint_space.JointLimit.by_joint(exposed.profile, rules)

    def way_watch(
        self, request: GateRequest, joints: Callable[[], JointSample | None]
    ) -> WayWatch | None:
        """Return the checks during a goal whose path a planner has chosen; None for a request
        without such a path of an arm.

        Args:
            request: an allowed request.
            joints: returns the newest measured joints.
        """
        found = self._entries.get((request.robot, request.endpoint))
        if found is None or not found.checks.has_plans:
            return None
        return watch_of(found.allowed, request.messages, joints)

    def release(self, request: GateRequest) -> None:
        """Remove the request's unsent messages from the rate count, because they will not
        be sent.
        """
        found = self._entries.get((request.robot, request.endpoint))
        if found is not None:
            found.rate.release(request)

    def _judge(self, request: GateRequest, simulated: bool) -> tuple[Verdict, RefusedError | None]:
        rule, clamped = "", list[Clamp]()
        try:
            for name in self._rules(request, simulated, clamped):
                rule = name  # the last name yielded is that of the rule that raises
        except RefusedError as error:
            error.rule = error.limit if isinstance(error, LimitError) else rule
            verdict = Verdict(
                allowed=False, simulated=simulated, reason=str(error), rule=error.rule
            )
            return verdict, error
        return Verdict(allowed=True, simulated=simulated, clamped=tuple(clamped)), None

    def _rules(self, request: GateRequest, simulated: bool, clamped: list[Clamp]) -> Iterator[str]:
        """Apply one rule after the other: its name is yielded before it is applied, and it raises
        RefusedError.
        """
        yield "allow_list"
        if (request.robot, request.endpoint) not in self._entries:
            raise _not_allowed(request, self._entries)
        found = self._entries[request.robot, request.endpoint]
        entry, checks = found.allowed, found.checks
        endpoint = entry.endpoint
        yield "role"
        least = ROLE_BY_KIND[endpoint.kind]
        least.check(request.who[:60], request.role[:20], repr(endpoint.name))
        yield "type"
        if endpoint.kind != "read" and not request.messages:
            raise RefusedError(f"No message came for endpoint {endpoint.name!r}.")
        for message in request.messages:
            checks.check_type(message)
        yield "finite"
        for message in request.messages:
            checks.check_finite(message)
        if self.transforms is not None and (endpoint.frame or checks.has_plans):
            yield "frame"
            for message in request.messages:
                if endpoint.frame:
                    clamped += to_frame(endpoint, message, self.transforms)
                if checks.has_plans and entry.profile is not None:
                    base = entry.profile.base_link
                    clamped += constraints_to_frame(message, base, self.transforms)
        yield "bounds"
        for message in request.messages:
            clamped += checks.apply_bounds(message)
        if endpoint.min_turning_radius_m > 0.0:
            yield "steering"
            for message in request.messages:
                check_steering(endpoint, message)
        if endpoint.frame:
            yield "place"
            for message in request.messages:
                check_places(endpoint, message)
        is_planned = endpoint.joint_limited and checks.has_plans
        if is_planned:
            yield "goal"
            with _judging():
                is_planned = check_plans(entry, request.messages, request.joints)
        elif checks.has_plans and entry.profile is not None and entry.profile.limits is not None:
            yield "goal"
            for message in request.messages:
                check_plan_only(message)
        if endpoint.joint_limited and not (is_planned and not _commands(request)):
            yield "joints"
            legs = _legs(entry, request)
            yield "kinematics"
            if entry.path is not None:
                if request.joints is None:
                    raise RefusedError(
                        "The joints were not measured yet, so the arm's way cannot be checked.",
                        hint="Start the robot first.",
                    )
                with _judging():
                    entry.path().check(legs, request.joints)
        yield "path"
        if simulated and request.predict is not None:
            with _judging():
                request.predict()
        if endpoint.kind != "read":
            yield "emergency_stop"
            self.latch.check(" Nothing was sent.")
        yield "rate"
        if not request.repeated:
            self._check_rate(found.rate, request, simulated)

    def _check_rate(self, rate: RateLimit, request: GateRequest, simulated: bool) -> None:
        times_s = request.send_at_s or (0.0,) * max(1, len(request.messages))
        wait_s = rate.wait_s(times_s) if simulated else rate.take(times_s, request)
        if wait_s == 0.0:
            return
        name = request.endpoint
        if math.isinf(wait_s):
            text = (
                f"The messages for {name!r} follow each other faster than its {rate.rate_hz:g} "
                "per second."
            )
            raise RefusedError(text, hint="Give the steps more time.")
        raise RefusedError(f"Too many messages for {name!r}.", hint=f"Wait {wait_s:.2f} s.")

    def _write(self, request: GateRequest, verdict: Verdict) -> None:
        words = ("would_refuse", "would_allow") if verdict.simulated else ("refused", "allowed")
        record = AuditRecord(
            who=request.who[:200],
            role=request.role[:20],
            tool=request.tool[:200],
            robot=request.robot[:200],
            endpoint=request.endpoint[:200],
            verdict=words[verdict.allowed],
            rule=verdict.rule,
            reason=verdict.reason[:500],
            arguments=request.arguments,
            clamped=tuple(f"{c.path}: {c.asked:g} -> {c.sent:g}" for c in verdict.clamped[:20]),
        )
        try:
            self.audit.write(record)
        except RefusedError:  # reading continues and refusals stay refusals when the disk is full
            found = self._entries.get((request.robot, request.endpoint))
            if found is not None and found.allowed.endpoint.kind != "read" and verdict.may_send:
                raise


def _commands(request: GateRequest) -> list[Any]:
    return [command for message in request.messages for command in joint_commands(message)]


def _legs(entry: AllowedEndpoint, request: GateRequest) -> list[Leg]:
    """Return the joint path of a request; raises RefusedError as `check_joints`."""
    commands = _commands(request)
    if entry.profile is None or not commands:
        raise RefusedError(
            f"The joint limits of {entry.endpoint.name!r} cannot be checked for "
            f"{entry.endpoint.type}."
        )
    durations_s = request.durations_s if len(request.durations_s) == len(commands) else ()
    limits = joint_space.JointLimit.by_joint(entry.profile, entry.rules)
    return check_joints(limits, commands, request.joints, durations_s)


@contextmanager
def _judging() -> Iterator[None]:
    """Convert errors in evaluating a path to refusals."""
    try:
        yield
    except RefusedError:
        raise
    except RoboNeuronError as error:
        raise RefusedError(
            f"The path of the arm cannot be checked: {error.message}", hint=error.hint
        ) from error


def _not_allowed(request: GateRequest, entries: Mapping[_Key, object]) -> RefusedError:
    exposed = sorted({name for robot, name in entries if robot == request.robot})
    if not exposed:
        robots = ", ".join(sorted({robot for robot, _ in entries})) or "none"
        return RefusedError(
            f"No endpoint of a robot called {request.robot[:60]!r} is exposed; robots: {robots}."
        )
    listed = ", ".join(exposed[:20]) + (" ..." if len(exposed) > 20 else "")
    return RefusedError(
        f"{request.endpoint[:60]!r} of {request.robot!r} is not exposed; exposed are: {listed}."
    )
