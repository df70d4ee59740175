"""The emergency stop of the server: two independent channels to every module, and confirmation by
the modules.

The latch file stops modules without any other process and outlives them all; the topic also reaches
foreign nodes.
"""

from __future__ import annotations

import logging
import signal
import threading
import time
from collections.abc import Callable
from queue import SimpleQueue

from roboneuron.errors import NotReadyError, UnsafeError
from roboneuron.estop.latch import EmergencyStopLatch, latched_reason
from roboneuron.estop.pin import ReleasePin
from roboneuron.gate import AuditLog, AuditRecord, StillReason
from roboneuron.modules.settings import EMERGENCY_STOP_TOPIC
from roboneuron.supervisor.supervisor import Supervisor

log = logging.getLogger(__name__)
_ROUNDS = 3
"""Executor cycles after which every message published before the first has been delivered."""
SIGNAL = "the signal SIGUSR1"
CONFIRM_S = 2.0
"""Timeout of the confirmation. Modules report a change at once; this is ten times their longest
period, for a busy machine.
"""


def press_on_signal(latch: Callable[[str], object]) -> None:
    """Install the handler of SIGUSR1, which calls `latch`; called on the main thread.

    Args:
        latch: called with the origin of the stop, on another thread.
    """
    # its `put` may be interrupted by another `put`: handlers run within handlers
    signals: SimpleQueue[int] = SimpleQueue()

    def press() -> None:
        """Latch on another thread: the interrupted one may hold any lock."""
        while signals.get():
            while not signals.empty():  # a repeated signal counts once
                signals.get()
            try:
                latch(SIGNAL)
            except (UnsafeError, NotReadyError) as error:
                log.error("%s", error)

    threading.Thread(target=press, name="emergency-stop", daemon=True).start()
    signal.signal(signal.SIGUSR1, lambda number, _: signals.put(number))  # may interrupt itself


class EmergencyStop:
    """Writes the latch file, and publishes in the namespace of every started module; usable from
    any thread.

    Attributes:
        file: the latch, which the gate checks before every message.
        audit: log of stops and resets.
    """

    def __init__(self, supervisor: Supervisor) -> None:
        """Args:
        supervisor: supervisor of the modules to be stopped; the latch is in its state directory.
        """
        self._supervisor = supervisor
        # guards the creation of publishers; a stop only reads the dictionary
        self._lock = threading.Lock()
        self._publishers: dict[str, Callable[[bool], None]] = {}
        # the last published value
        self._is_told = False
        self._restored = 0
        self.file = EmergencyStopLatch.in_directory(supervisor.state_directory)
        self.file.on_pressed.append(lambda: self._publish(True))
        self.audit = AuditLog.in_directory(supervisor.state_directory)

    @property
    def needs_pin(self) -> bool:
        """True if releasing the stop requires a PIN."""
        return ReleasePin(self.file.path.parent).is_set

    def is_latched(self) -> bool:
        """True if the stop is latched: by the file, from any source, or in any module.

        A module may be latched without the file: by the topic, if the file cannot be written.
        """
        return self.file.is_latched() or any(
            view.report is not None and view.report.emergency_stop is True
            for view in self._supervisor.views()
        )

    def check(self) -> None:
        """Raise RefusedError, which names the origin, if it is latched."""
        reason = self.still_reason()
        if reason is not None:
            raise reason.refusal()

    def still_reason(self) -> StillReason | None:
        """Why nothing moves while it is latched, by the file or in a module; None if it is not."""
        return latched_reason(self.cause()) if self.is_latched() else None

    def cause(self) -> str:
        """Origin and reason, as far as known; empty if not latched."""
        return self.file.read_state().cause

    def prepare(self, namespace: str) -> None:
        """Advertise the topic in advance, with the latch's present state for modules that start
        later.

        Args:
            namespace: namespace of the robot.

        Raises:
            RoboNeuronError: ROS cannot be joined; the file stops without it.
        """
        self._advertise(namespace)
        self._publishers[namespace](self.file.is_latched())

    def _advertise(self, namespace: str) -> None:
        """Publish and subscribe to the stop in a namespace, once in the server's life."""
        link = self._supervisor.link  # first: two threads must not import rclpy at the same time
        from std_msgs.msg import Bool  # heavy

        from roboneuron.ros.qos import LATCHED, STOP_REQUESTS

        topic = f"/{namespace}/{EMERGENCY_STOP_TOPIC}"

        with self._lock:
            if namespace not in self._publishers:
                send = link.advertise(Bool, topic, LATCHED)
                for qos in STOP_REQUESTS:
                    link.subscribe(
                        Bool, topic, lambda message: self._on_topic(topic, message.data), qos
                    )
                # no effect once the server leaves the graph: modules confirm what they received
                self._publishers[namespace] = lambda is_latched: send(Bool(data=is_latched))

    def follow_file(self) -> bool:
        """Return True if the file is latched. Called periodically, which keeps the server latched
        if the file vanishes; that is audited, because it looks like a release.

        A user's reset releases the file only. The last published value stays on the topic for nodes
        that join later, which would latch again.
        """
        is_latched, restored = self.file.is_latched(), self.file.read_state().restored
        if restored > self._restored:
            self.audit.write_if_possible(
                AuditRecord(who="server", role="", tool="emergency_stop", verdict="restored")
            )
        self._restored = restored
        if self._is_told and not is_latched:
            self._publish(False)
            if self.file.is_latched():  # latched meanwhile
                self._publish(True)
        return self.file.is_latched()

    def _publish(self, is_latched: bool) -> None:
        """Notify all modules by the topic; does not wait."""
        self._is_told = is_latched
        for publish in list(self._publishers.values()):
            publish(is_latched)

    def _on_topic(self, topic: str, is_pressed: bool) -> None:
        """Handle the topic: any node may stop, none may release. The server's own messages arrive
        too.
        """
        if is_pressed and not self.file.is_latched():
            try:
                self.file.press(who=f"a node on the topic {topic}", reason="received by the server")
            except UnsafeError as error:
                log.error("%s", error)

    def latch(self, namespace: str, *, who: str, reason: str) -> tuple[list[str], float]:
        """Stop all motion; return the modules that confirmed it, and the time that took [s].

        Args:
            namespace: namespace of the robot.
            who: a client, person or signal.
            reason: may be empty.

        Raises:
            UnsafeError: a running module did not confirm it in time (the message names it), or the
                latch file cannot be written; the other channel was used nevertheless.
        """
        try:
            self.file.latch(who=who, reason=reason, audit=self.audit)
        finally:
            confirmed, silent, took_s = self._tell(namespace, True)
        if silent:
            raise UnsafeError(
                f"The emergency stop was sent, but not confirmed within {CONFIRM_S:g} s by: "
                f"{', '.join(silent)}.",
                hint="Use the robot's own stop if it moves, then stop_all.",
            )
        return confirmed, took_s

    def reset(
        self,
        namespace: str,
        *,
        who: str,
        role: str,
        pin: str = "",
        agreed_ns: int | None = None,
    ) -> tuple[list[str], float]:
        """Release the latch. Returns as `latch`.

        Args:
            namespace: namespace of the robot.
            who: the client.
            role: role of that client.
            pin: PIN typed by a person, if one is set.
            agreed_ns: see `EmergencyStopLatch.reset`.

        Raises:
            RefusedError: as `EmergencyStopLatch.reset`.
            StateError: the latch file cannot be removed.
            NotReadyError: a running module did not confirm it in time.
        """
        # the server's own messages must arrive first: after the reset they would latch again
        if self._publishers:
            for _ in range(_ROUNDS):
                self._supervisor.link.on_executor(lambda: None)
        self.file.reset(who=who, role=role, audit=self.audit, pin=pin, agreed_ns=agreed_ns)
        confirmed, silent, took_s = self._tell(namespace, False)
        if silent:
            raise NotReadyError(
                f"The reset was sent, but not confirmed within {CONFIRM_S:g} s by: "
                f"{', '.join(silent)}.",
                hint="Look at get_status; call reset_emergency_stop again.",
            )
        return confirmed, took_s

    def _tell(self, namespace: str, latched: bool) -> tuple[list[str], list[str], float]:
        """Publish the state and wait for the modules: those that confirmed, those that did not, and
        the time that took [s].
        """
        started_s = time.monotonic()
        self._advertise(namespace)
        self._publish(latched)
        log.warning("Emergency stop %s.", "latched" if latched else "released")

        self._supervisor.changes.wait_for(
            lambda: not self._unconfirmed(latched, started_s), CONFIRM_S
        )
        silent = self._unconfirmed(latched, started_s)
        running = [view.kind for view in self._supervisor.views() if view.phase == "running"]
        return (
            [kind for kind in running if kind not in silent],
            silent,
            time.monotonic() - started_s,
        )

    def _unconfirmed(self, latched: bool, since_s: float) -> list[str]:
        """Running modules that have not reported the latch since then.

        Args:
            latched: the state to report.
            since_s: older reports do not count [monotonic s].
        """
        return [
            view.kind
            for view in self._supervisor.views()
            if view.phase == "running"
            and (
                view.report is None
                or view.report.received_s < since_s
                or view.report.emergency_stop is not latched
            )
        ]
