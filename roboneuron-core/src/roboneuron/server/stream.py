"""The action topic as the control plane sees it while a backend is replaced: values and DDS source times."""

from __future__ import annotations

import statistics
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from roboneuron.ros.link import RosLink

_KEPT = 4096
_RECENT = 20


@dataclass(frozen=True, kw_only=True, slots=True)
class Gap:
    """What a change-over did to the stream of actions.

    Attributes:
        gap_s: from the last action of the old backend to the first of the new one.
        period_s: median time between the old one's last actions.
    """

    gap_s: float
    period_s: float

    @property
    def missed(self) -> int:
        """Actions that would have come in the old one's rhythm and did not; half a period late is still in rhythm."""
        return max(0, round(self.gap_s / self.period_s) - 1)


class ActionStream:
    """Listens to `/<namespace>/action` until it is closed.

    Times are DDS source times [ns]: when the inference process sent the action, whatever the way to here took.
    """

    def __init__(self, link: RosLink, namespace: str) -> None:
        from std_msgs.msg import Float64MultiArray  # heavy

        from roboneuron.ros.qos import STATUS
        from roboneuron.ros.topics import ACTION

        self._lock = threading.Lock()
        self._actions: deque[tuple[int, tuple[float, ...]]] = deque(maxlen=_KEPT)

        def receive(message: Any, info: dict[str, Any]) -> None:
            with self._lock:
                self._actions.append((int(info["source_timestamp"]), tuple(message.data)))

        topic = f"/{namespace}/{ACTION}"
        # Many are kept in between: a busy control plane must not mistake its own delay for a missing action.
        subscription = link.on_executor(
            lambda: link.node.create_subscription(Float64MultiArray, topic, receive, STATUS)
        )
        self._end: Callable[[], object] = lambda: link.on_executor(lambda: link.node.destroy_subscription(subscription))

    def close(self) -> None:
        """Stop listening."""
        self._end()

    def since(self, moment_ns: int) -> list[tuple[float, ...]]:
        """Values of the actions sent at or after a moment."""
        with self._lock:
            return [values for sent_ns, values in self._actions if sent_ns >= moment_ns]

    def newest(self, most: int) -> list[tuple[int, tuple[float, ...]]]:
        """The newest actions: source time [ns] and values, oldest first."""
        with self._lock:
            return list(self._actions)[-most:]

    def gap(self, first_ns: int) -> Gap | None:
        """The gap before the action sent at `first_ns` [ns] or right after it; None without two actions before it."""
        with self._lock:
            times = [sent_ns for sent_ns, _ in self._actions]
        before = [sent_ns for sent_ns in times if sent_ns < first_ns][-_RECENT:]
        first = next((sent_ns for sent_ns in times if sent_ns >= first_ns), None)
        if len(before) < 2 or first is None:
            return None
        period_ns = statistics.median(b - a for a, b in pairwise(before))
        return Gap(gap_s=(first - before[-1]) / 1e9, period_s=max(1e-6, period_ns / 1e9))
