"""The one gate: everything an agent sends passes it, and every decision is written down.

Order: allow list, role, type, finiteness, bounds, steering, joint limits, emergency stop, rate, audit. The first rule
that does not hold refuses and does not count against the rate. Refuse by default, clamp only where configured.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from roboneuron.errors import RefusedError
from roboneuron.gate.audit import AuditLog, AuditRecord
from roboneuron.gate.estop import EmergencyStopLatch, LatchState
from roboneuron.gate.joints import JOINT_TYPES, check_joints
from roboneuron.gate.limits import apply_bounds, check_endpoint, check_finite, check_steering, check_type
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
            _apply("emergency_stop", self.latch.check)
        if not request.repeated:
            self._check_rate(rate, endpoint.name, dry_run)
        return tuple(clamped)

    def _check_joints(self, entry: AllowedEndpoint, request: GateRequest) -> None:
        if not entry.endpoint.joint_limited:
            return
        if entry.profile is None or entry.endpoint.type not in JOINT_TYPES:
            text = f"The joint limits of {entry.endpoint.name!r} cannot be checked for {entry.endpoint.type}."
            raise _Refusal("joints", RefusedError(text))
        _apply("joints", check_joints, entry.profile, request.messages, request.joints, request.durations_s)

    def _check_rate(self, rate: RateLimit, name: str, dry_run: bool) -> None:
        wait_s = rate.wait_s() if dry_run else rate.take()
        if wait_s > 0.0:
            raise _Refusal("rate", RefusedError(f"Too many calls of {name!r}.", hint=f"Wait {wait_s:.2f} s."))

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
