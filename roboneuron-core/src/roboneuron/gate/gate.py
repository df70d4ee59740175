"""The one gate: everything an agent sends passes it, and every decision is written down.

Order: allow list, role, type, finiteness, bounds, steering, joint limits, emergency stop, rate, audit. The first rule
that does not hold refuses and does not count against the rate. Refuse by default, clamp only where configured.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

from roboneuron.errors import RefusedError, RoboNeuronError
from roboneuron.gate.audit import AuditLog, AuditRecord
from roboneuron.gate.estop import EmergencyStopLatch, LatchState
from roboneuron.gate.joint_limits import joint_limits
from roboneuron.gate.joints import check_joints, joint_commands
from roboneuron.gate.limits import apply_bounds, check_endpoint, check_finite, check_steering, check_type
from roboneuron.gate.motion import Leg, LimitError
from roboneuron.gate.rate import RateLimit
from roboneuron.gate.request import ROLE_BY_KIND, AllowedEndpoint, Clamp, GateRequest, Verdict, has_role

_Key = tuple[str, str]


class _Refusal(Exception):
    """A rule that does not hold."""

    def __init__(self, rule: str, cause: RefusedError) -> None:
        super().__init__(rule)
        self.rule = rule
        self.cause = cause


class Gate:
    """Decides on requests; safe from any thread.

    Attributes:
        latch: the emergency stop.
        audit: where decisions are written.
    """

    def __init__(
        self,
        allowed: Iterable[AllowedEndpoint],
        *,
        latch: EmergencyStopLatch,
        audit: AuditLog,
        clock: Callable[[], float],
        dry_run: bool = False,
    ) -> None:
        """Args:
        allowed: the allow list; nothing else is reachable.
        latch: the emergency stop, shared with every process.
        audit: where decisions are written.
        clock: monotonic time [s], for rates.
        dry_run: answer every request, allow none to be sent.

        Raises:
            ConfigurationError: an endpoint cannot be exposed.
        """
        self.latch = latch
        self.audit = audit
        self._clock = clock
        self._dry_run = dry_run
        self._entries: dict[_Key, tuple[AllowedEndpoint, RateLimit]] = {}
        self._rates: dict[tuple[str, ...], RateLimit] = {}
        self.replace(allowed)

    def replace(self, allowed: Iterable[AllowedEndpoint]) -> None:
        """Change the allow list; rates of endpoints that stay the same go on counting.

        Raises:
            ConfigurationError: an endpoint cannot be exposed; the old list stays.
        """
        entries: dict[_Key, tuple[AllowedEndpoint, RateLimit]] = {}
        rates: dict[tuple[str, ...], RateLimit] = {}
        for entry in allowed:
            endpoint = entry.endpoint
            check_endpoint(endpoint)
            # Two names of one topic are one stream of messages, whose rate the robot has to take.
            place = (endpoint.kind, entry.topic) if entry.topic else (endpoint.kind, entry.robot, endpoint.name)
            use = (*place, str(endpoint.rate_hz))
            if use not in rates:
                rates[use] = self._rates.get(use) or RateLimit(endpoint.rate_hz, self._clock)
            entries[entry.robot, endpoint.name] = (entry, rates[use])
        self._entries, self._rates = entries, rates

    def allowed(self) -> tuple[AllowedEndpoint, ...]:
        """The allow list."""
        return tuple(entry for entry, _ in self._entries.values())

    def check(self, request: GateRequest) -> Verdict:
        """Decide, write the decision down, and return it; send only when `Verdict.may_send`.

        The messages of an allowed request may have been clamped; the verdict says so.

        Raises:
            RefusedError: refused. A dry run is answered instead, with `allowed` false and the reason.
        """
        dry_run = request.dry_run or self._dry_run
        try:
            clamped = self._judge(request, dry_run)
        except _Refusal as refusal:
            verdict = Verdict(allowed=False, dry_run=dry_run, reason=str(refusal.cause), rule=refusal.rule)
            cause: RefusedError | None = refusal.cause
        else:
            verdict, cause = Verdict(allowed=True, dry_run=dry_run, clamped=clamped), None
        self._write(request, verdict)
        if cause is not None and not dry_run:
            raise cause
        return verdict

    def check_next(self, request: GateRequest) -> None:
        """Judge one more message of a motion that was allowed; only a refusal is written down.

        Raises:
            RefusedError: refused; the motion has to end.
        """
        try:
            self._judge(replace(request, repeated=True), self._dry_run)
        except _Refusal as refusal:
            self._write(request, Verdict(allowed=False, reason=str(refusal.cause), rule=refusal.rule))
            raise refusal.cause from refusal

    def check_running(self) -> None:
        """Raise RefusedError when motion that is under way has to end: latched, or the audit failed.

        Called before every step of a sequence and every repetition; about a microsecond.
        """
        self.latch.check()
        if self.audit.failed:
            raise RefusedError("The audit cannot be written; motion ends.", hint="Mend the state directory.")

    def emergency_stop(self, *, who: str, role: str, reason: str) -> LatchState:
        """Latch the stop; every role may. It is written down if possible and holds even if not.

        Raises:
            UnsafeError: other processes cannot be told.
        """
        try:
            return self.latch.latch(who=who, reason=reason)
        finally:
            record = AuditRecord(who=who, role=role, tool="emergency_stop", verdict="latched", reason=reason[:500])
            self._write_if_possible(record)

    def reset_emergency_stop(self, *, who: str, role: str) -> None:
        """Release the latch. Raises RefusedError and StateError as `EmergencyStopLatch.reset`."""
        self.latch.reset(who=who, role=role, audit=self.audit)

    def _judge(self, request: GateRequest, dry_run: bool) -> tuple[Clamp, ...]:
        found = self._entries.get((request.robot, request.endpoint))
        if found is None:
            raise _Refusal("allow_list", _not_allowed(request, self._entries))
        entry, rate = found
        endpoint = entry.endpoint
        least = ROLE_BY_KIND[endpoint.kind]
        if not has_role(request.role, least):
            text = f"{endpoint.name!r} needs the role {least!r}, {request.who[:60]!r} has {request.role[:20]!r}."
            raise _Refusal("role", RefusedError(text))
        if endpoint.kind != "read" and not request.messages:
            raise _Refusal("type", RefusedError(f"No message came for endpoint {endpoint.name!r}."))
        clamped: list[Clamp] = []
        for message in request.messages:
            _apply("type", check_type, endpoint, message)
            _apply("finite", check_finite, entry, message)
        for message in request.messages:
            clamped += _apply("bounds", apply_bounds, entry, message)
            _apply("steering", check_steering, endpoint, message)
        self._check_joints(entry, request)
        if endpoint.kind != "read":
            _apply("emergency_stop", self._check_latch)
        if not request.repeated:
            self._check_rate(rate, request, dry_run)
        return tuple(clamped)

    def _check_latch(self) -> None:
        try:
            self.latch.check()
        except RefusedError as error:
            raise RefusedError(f"{error.message} Nothing was sent.", hint=error.hint) from error

    def _check_joints(self, entry: AllowedEndpoint, request: GateRequest) -> None:
        if not entry.endpoint.joint_limited:
            return
        legs = _apply("joints", _legs, entry, request)
        if entry.path is None or request.joints is None:
            return
        try:
            entry.path().check(legs, request.joints)
        except LimitError as error:
            raise _Refusal(error.limit, error) from error
        except RoboNeuronError as error:
            raise _Refusal("kinematics", _unjudged(error)) from error

    def slowdown(self, request: GateRequest) -> float:
        """How many times the request's time the TCP needs to keep to its speeds, at least 1.

        Raises:
            RefusedError: the way cannot be judged.
        """
        found = self._entries.get((request.robot, request.endpoint))
        if found is None or found[0].path is None or request.joints is None:
            return 1.0
        try:
            return found[0].path().slowdown(_legs(found[0], request), request.joints)
        except RefusedError:
            raise
        except RoboNeuronError as error:
            raise _unjudged(error) from error

    def release(self, request: GateRequest) -> None:
        """Messages of the request that were to be sent later will not be; they no longer count against the rate."""
        found = self._entries.get((request.robot, request.endpoint))
        if found is not None:
            found[1].release(request)

    def _check_rate(self, rate: RateLimit, request: GateRequest, dry_run: bool) -> None:
        times_s = request.send_at_s or (0.0,) * max(1, len(request.messages))
        wait_s = rate.wait_s(times_s) if dry_run else rate.take(times_s, request)
        if wait_s == 0.0:
            return
        name = request.endpoint
        if math.isinf(wait_s):
            text = f"The messages for {name!r} follow each other faster than its {rate.rate_hz:g} per second."
            raise _Refusal("rate", RefusedError(text, hint="Give the steps more time."))
        raise _Refusal("rate", RefusedError(f"Too many messages for {name!r}.", hint=f"Wait {wait_s:.2f} s."))

    def _write(self, request: GateRequest, verdict: Verdict) -> None:
        words = ("would_refuse", "would_allow") if verdict.dry_run else ("refused", "allowed")
        found = self._entries.get((request.robot, request.endpoint))
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
        if found is not None and found[0].endpoint.kind != "read" and verdict.may_send:
            self.audit.write(record)
        else:
            self._write_if_possible(record)

    def _write_if_possible(self, record: AuditRecord) -> None:
        """For what moves nothing: reading goes on and refusals stay refusals when the disk is full."""
        try:
            self.audit.write(record)
        except RefusedError:
            return


def _legs(entry: AllowedEndpoint, request: GateRequest) -> list[Leg]:
    """The way of the joints that a request asks for; raises RefusedError as `check_joints`."""
    commands = [command for message in request.messages for command in joint_commands(message)]
    if entry.profile is None or not commands:
        raise RefusedError(f"The joint limits of {entry.endpoint.name!r} cannot be checked for {entry.endpoint.type}.")
    durations_s = request.durations_s if len(request.durations_s) == len(commands) else ()
    return check_joints(joint_limits(entry.profile, entry.rules), commands, request.joints, durations_s)


def _unjudged(error: RoboNeuronError) -> RefusedError:
    return RefusedError(f"The way of the arm cannot be judged: {error.message}", hint=error.hint)


def _apply(rule: str, check: Callable[..., Any], *arguments: Any) -> Any:
    try:
        return check(*arguments)
    except RefusedError as error:
        raise _Refusal(rule, error) from error


def _not_allowed(request: GateRequest, entries: dict[_Key, tuple[AllowedEndpoint, RateLimit]]) -> RefusedError:
    exposed = sorted({name for robot, name in entries if robot == request.robot})
    if not exposed:
        robots = ", ".join(sorted({robot for robot, _ in entries})) or "none"
        return RefusedError(f"No endpoint of a robot called {request.robot[:60]!r} is exposed; robots: {robots}.")
    listed = ", ".join(exposed[:20]) + (" ..." if len(exposed) > 20 else "")
    return RefusedError(f"{request.endpoint[:60]!r} of {request.robot!r} is not exposed; exposed are: {listed}.")
