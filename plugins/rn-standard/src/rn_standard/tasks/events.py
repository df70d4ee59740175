"""Events to which clients can subscribe, as resources: incidents, ends of tasks, a low battery,
crossed thresholds.
"""

from __future__ import annotations

import json
import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from functools import partial
from typing import TYPE_CHECKING

from rn_standard.tasks.options import EventOptions, ThresholdOptions
from roboneuron import ConfigurationError, Host, InvalidInputError, Resource, RoboNeuronError
from roboneuron.direct_path.fields import check_path, load_type, read_value
from roboneuron.feature import EXPLANATIONS, FAULTS, Health, ModuleView, check_topic

if TYPE_CHECKING:
    from sensor_msgs.msg import BatteryState

log = logging.getLogger(__name__)
URI = "roboneuron://events/"
INCIDENTS, TASKS, BATTERY, THRESHOLDS = "incidents", "tasks", "battery", "thresholds"
LEADS, MONITORS = "leads", "monitors"
KINDS: Mapping[str, str] = {
    INCIDENTS: "New incidents: a module that fails, stalls, falls silent or ends; restarts; "
    "lapsed leases.",
    TASKS: "Tasks of run_task that have ended, with their outcomes.",
    LEADS: "A person took the arm over, handed it back, or was lost.",
    MONITORS: "The monitor that watches tasks contradicts a predicate for a second.",
    BATTERY: "A battery that became low, or is charged again.",
    THRESHOLDS: "Crossings of the thresholds in [events.thresholds] of the configuration.",
}
"""Kinds of events, with one line each for agents."""
_AGAIN_S = 5.0
"""Time within which the same incident of the same module is reported only once."""
_CHARGED = 0.05
"""Margin above the limit at which a battery counts as charged again."""


def check_thresholds(options: EventOptions) -> None:
    """Check the topics, types and fields of `[events]` before anything is subscribed to.

    Raises:
        InvalidInputError, ConfigurationError: one is invalid.
    """
    check_topic(options.battery_topic)
    for name, threshold in options.thresholds.items():
        try:
            check_topic(threshold.topic)
            check_path(load_type(threshold.type), threshold.field)
        except (ConfigurationError, InvalidInputError) as error:
            raise InvalidInputError(
                f"[events.thresholds.{name}]: {error.message}", hint=error.hint
            ) from error


class Crossing:
    """Detects that a value crosses a limit; the state resets only after the hysteresis.

    Args:
        above, below: limits that the value must exceed or fall below; None for no such limit.
        hysteresis: distance by which it must return.
    """

    def __init__(self, above: float | None, below: float | None, hysteresis: float = 0.0) -> None:
        self._above = math.inf if above is None else above
        self._below = -math.inf if below is None else below
        self._hysteresis = hysteresis
        self.is_beyond = False

    def observe(self, value: float) -> bool:
        """Add a value; return True if `is_beyond` has changed. NaN changes nothing."""
        if self.is_beyond:
            back = self._below + self._hysteresis <= value <= self._above - self._hysteresis
            self.is_beyond = not back
            return back
        beyond = value > self._above or value < self._below
        self.is_beyond = beyond
        return beyond


class EventLog:
    """The newest events of each kind. Usable from any thread.

    Args:
        kept: number of events of each kind.
        tell: called with the URI of the changed resource.
    """

    def __init__(self, kept: int, tell: Callable[[str], object]) -> None:
        self._lock = threading.Lock()
        self._kept = {kind: deque[dict[str, object]](maxlen=kept) for kind in KINDS}
        self._count = 0
        self._tell = tell

    def add(self, kind: str, **facts: object) -> None:
        """Add an event; `facts` are JSON-serialisable."""
        with self._lock:
            self._count += 1
            at = datetime.now(UTC).isoformat(timespec="milliseconds")
            self._kept[kind].append({"number": self._count, "at": at, **facts})
        self._tell(URI + kind)

    def read(self, kind: str) -> str:
        """Return the events as JSON, newest last."""
        with self._lock:
            return json.dumps({"events": list(self._kept[kind])}, indent=1)

    def resources(self) -> Sequence[Resource]:
        """Create one resource for each kind."""
        return [
            Resource(
                uri=URI + kind,
                name=f"events: {kind}",
                title=f"Events: {kind}",
                description=f"{text} Subscribe to be told; the newest are kept.",
                read=partial(self.read, kind),
                mime_type="application/json",
            )
            for kind, text in KINDS.items()
        ]


class Watching:
    """Converts events of the server and of topics to subscribable events.

    Args:
        host, options: of the feature.
        events: receives them.
    """

    def __init__(self, host: Host, options: EventOptions, events: EventLog) -> None:
        self._host = host
        self._options = options
        self._events = events
        self._seen: dict[tuple[str, str], float] = {}
        self._ends: list[Callable[[], None]] = []
        host.events.health.listen(self._on_health)
        host.events.fault.listen(self._on_fault)

    def start(self) -> None:
        """Subscribe to the topics; one that cannot be used is logged and left out.

        Raises:
            RoboNeuronError: ROS cannot be joined, or the battery's topic cannot be used.
        """
        if self._options.battery_low > 0:
            low = Crossing(None, self._options.battery_low, _CHARGED)
            kind = load_type("sensor_msgs/msg/BatteryState")
            self._ends.append(
                self._host.subscribe(
                    kind, self._options.battery_topic, partial(self._on_battery, low), latched=True
                )
            )
        for name, threshold in self._options.thresholds.items():
            crossing = Crossing(threshold.above, threshold.below, threshold.hysteresis)
            take = partial(self._on_message, name, threshold, crossing)
            try:
                end = self._host.subscribe(load_type(threshold.type), threshold.topic, take)
            except (ConfigurationError, InvalidInputError) as error:
                log.warning("The threshold %r is not watched: %s", name, error)
            else:
                self._ends.append(end)

    def close(self) -> None:
        """Unsubscribe; idempotent."""
        while self._ends:
            try:
                self._ends.pop()()
            except RoboNeuronError as error:
                log.debug("A subscription is gone already: %s", error)

    def _on_health(self, view: ModuleView, before: Health, health: Health) -> None:
        if health in FAULTS:
            error = view.report.error if view.report is not None and view.report.error_code else ""
            self._incident(view.kind, health, EXPLANATIONS[health], error)

    def _on_fault(self, module: str, what: str, facts: Mapping[str, object]) -> None:
        self._incident(module, what, str(facts.get("explanation", "")), "")

    def _incident(self, module: str, what: str, explanation: str, error: str) -> None:
        now_s = time.monotonic()
        again = now_s - self._seen.get((module, what), -math.inf) < _AGAIN_S
        self._seen[module, what] = now_s
        if not again:
            self._events.add(
                INCIDENTS, module=module, what=what, explanation=explanation, error=error
            )

    def _on_battery(self, low: Crossing, message: BatteryState) -> None:
        share = float(message.percentage)
        if low.observe(share):
            self._events.add(
                BATTERY, low=low.is_beyond, charge=round(share, 3), limit=self._options.battery_low
            )

    def _on_message(
        self, name: str, threshold: ThresholdOptions, crossing: Crossing, message: object
    ) -> None:
        try:
            value = float(read_value(message, threshold.field))
        except (LookupError, TypeError, ValueError) as error:
            if (name, "field") not in self._seen:
                self._seen[name, "field"] = time.monotonic()
                log.error("The threshold %r cannot be watched: %s", name, error)
            return
        if crossing.observe(value):
            self._events.add(
                THRESHOLDS, name=name, beyond=crossing.is_beyond, value=value, topic=threshold.topic
            )
