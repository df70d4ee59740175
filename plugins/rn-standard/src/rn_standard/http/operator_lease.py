"""Admission of one operator at a time, under a lease only while it is present."""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from pydantic import Field

from roboneuron import CallContext, NoArguments, RefusedError, Result, Tool
from roboneuron.feature import (
    AuditLog,
    AuditRecord,
    Periodic,
    Role,
    StillReason,
)

log = logging.getLogger(__name__)
_LOOK_S = 0.05
TAKE_OVER, HEARTBEAT = "take_over", "heartbeat"


class OperatorResult(Result):
    """The present operator of the robot."""

    operator: str = Field(description="the only client that may act")
    before: str = Field(default="", description="previous operator; empty if there was none")
    lease_s: float | None = Field(
        default=None, description="motion ends when the operator is silent for this long"
    )


class OperatorLease:
    """Admission of calls. The first client that calls an acting tool is the operator until another
    one takes over.

    With a lease, every call of the operator renews it, and so do its open requests and streams
    (`present`). When it lapses, `on_lapse` is called once, on another thread, and any client may
    become the operator. Methods may be called from any thread.

    Args:
        lease_s: longest silence of the operator [s]; None for no lease.
        audit: records each take-over and lapse.
        on_lapse: ends all motion; called with the reason.
        clock: monotonic time [s].
        has_left: returns True if a client is gone for good, so that no take-over is necessary.
        by_streams: `present` renews the lease.
    """

    def __init__(
        self,
        lease_s: float | None,
        audit: AuditLog,
        on_lapse: Callable[[str], None],
        clock: Callable[[], float] = time.monotonic,
        has_left: Callable[[str], bool] = lambda who: False,
        by_streams: bool = True,
    ) -> None:
        self._lease_s = lease_s
        self._audit = audit
        self._on_lapse = on_lapse
        self._clock = clock
        self._has_left = has_left
        self._by_streams = by_streams
        self._open: Counter[str] = Counter()
        self._is_vacant = False
        # taken before the audit's lock: a take-over is audited while no other call is admitted
        self._lock = threading.Lock()
        self._operator = ""
        self._renewed_s = 0.0
        self._thread = Periodic("lease", _LOOK_S, self.look)

    def admit(self, tool: Tool, context: CallContext) -> None:
        """Admit or refuse a call. Tools that read or stop are open to all clients.

        Raises:
            RefusedError: another client operates the robot.
        """
        acts = not tool.read_only and not tool.always and tool.name not in (TAKE_OVER, HEARTBEAT)
        with self._lock:
            if acts and context.who != self._operator and self._is_free():
                self._operator = context.who
            if context.who == self._operator:
                self._renew()
            elif acts:
                raise self._reason(context).refusal()

    def still_reasons(self, asker: CallContext | None) -> Sequence[StillReason]:
        """Why a client may not move the robot: another one operates it."""
        with self._lock:
            is_other = asker is not None and asker.who != self._operator and not self._is_free()
        return (self._reason(asker),) if asker is not None and is_other else ()

    def _reason(self, asker: CallContext) -> StillReason:
        return StillReason(
            rank="operator",
            rule="operator",
            message=f"{self._operator!r} operates the robot, {asker.who!r} may only read and stop.",
            hint=f"Call {TAKE_OVER} if that is agreed.",
        )

    def take_over(self, who: str, role: str) -> str:
        """Make `who` the operator; return the previous one. Motion continues, and started modules
        keep running.

        Raises:
            RefusedError: the audit cannot be written.
        """
        with self._lock:
            before = "" if self._is_vacant else self._operator
            if before != who:
                reason = f"took over from {before}" if before else "there was no operator"
                self._audit.write(
                    AuditRecord(
                        who=who, role=role, tool=TAKE_OVER, verdict="allowed", reason=reason
                    )
                )
                log.warning("%s operates the robot now; %s.", who, reason)
            self._operator = who
            self._renew()
            return before if before != who else ""

    def note_client(self, who: str, is_here: bool) -> None:
        """Record that a client has called a tool, of any robot, or has disconnected."""
        if not is_here:
            self.release(who)
            return
        with self._lock:
            if who == self._operator:
                self._renewed_s = self._clock()

    def release(self, who: str) -> None:
        """Handle a client's end; if it was the operator, the next acting client becomes it. A lease
        continues until it lapses.
        """
        with self._lock:
            if who == self._operator:
                self._is_vacant = True

    @contextmanager
    def present(self, who: str) -> Iterator[None]:
        """Count a request, a stream or a page as open within the block: its client is not
        silent.
        """
        self.note_presence(who, 1)
        try:
            yield
        finally:
            self.note_presence(who, -1)

    def note_presence(self, who: str, change: int) -> None:
        """Count a request or stream that a client has opened (1) or closed (-1)."""
        if not self._by_streams:
            return
        with self._lock:
            self._open[who] += change
            if self._open[who] <= 0:
                del self._open[who]
            if who == self._operator:
                self._renewed_s = self._clock()

    def _is_free(self) -> bool:
        return not self._operator or self._is_vacant or self._has_left(self._operator)

    def _renew(self) -> None:
        self._renewed_s = self._clock()
        self._is_vacant = False

    def look(self) -> None:
        """End motion if the lease has lapsed."""
        with self._lock:
            if not self._operator or self._lease_s is None or self._open[self._operator]:
                return
            silent_s = self._clock() - self._renewed_s
            if silent_s <= self._lease_s:
                return
            who, self._operator = self._operator, ""
        reason = (
            f"The lease of {who!r} has lapsed: silent for {silent_s:.2f} s, "
            f"{self._lease_s:g} s are allowed."
        )
        log.error("%s", reason)
        try:
            self._on_lapse(reason)
        finally:
            record = AuditRecord(who=who, role="", tool="lease", verdict="lapsed", reason=reason)
            try:
                self._audit.write(record)
            except RefusedError as error:  # motion has ended; a missing record does not change that
                log.error("The lapse is not in the audit: %s", error)

    def start(self) -> None:
        """Start watching the lease, if there is one."""
        if self._lease_s is not None:
            self._thread.start()

    def close(self) -> None:
        """Stop watching; idempotent."""
        self._thread.close()

    def tools(self) -> list[Tool]:
        """Create take_over and heartbeat."""

        async def take_over(_: NoArguments, context: CallContext) -> OperatorResult:
            before = self.take_over(context.who, context.role)
            return OperatorResult(operator=context.who, before=before, lease_s=self._lease_s)

        async def heartbeat(_: NoArguments, context: CallContext) -> OperatorResult:
            return OperatorResult(operator=self._operator, lease_s=self._lease_s)

        return [
            Tool(
                name=TAKE_OVER,
                title="Operate the robot",
                description=(
                    "Become the operator: the only client that may act; all others may read and "
                    "stop. The first client that acts becomes it by itself. What runs keeps "
                    "running."
                ),
                arguments=NoArguments,
                result=OperatorResult,
                handler=take_over,
                idempotent=True,
                role=Role.OPERATOR,
            ),
            Tool(
                name=HEARTBEAT,
                title="Renew the lease",
                description=(
                    "Renew the operator's lease. Every call of the operator does so too; if it "
                    "is silent for [http] lease_s, the policy is stopped and the arm holds."
                ),
                arguments=NoArguments,
                result=OperatorResult,
                handler=heartbeat,
                idempotent=True,
                seldom=True,
            ),
        ]
