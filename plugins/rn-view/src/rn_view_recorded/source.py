"""A recorded run as the source of a view: delivers its messages like the topics did."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from rn_recorder_runs.episodes import stamp_of
from rn_recorder_runs.files import Record
from rn_recorder_runs.images import pixels_of
from rn_recorder_runs.timeline import Timeline
from rn_view.diagnostics.active_limits import limit_counts
from rn_view.diagnostics.event_list import ShownEvent
from rn_view.recordings.playback import Playback
from rn_view.sources.source import MODULE_KINDS, ModuleRow, PageState, module_row, robot_profile
from rn_view_recorded.log import RunLog
from roboneuron import (
    ForeignDataError,
    InvalidInputError,
    RobotProfile,
    StateError,
    foreign,
)
from roboneuron.feature import Config, ModuleView, Periodic, Registry, Report
from roboneuron.modules.arm_paths import UncheckedPaths

log = logging.getLogger(__name__)
M = TypeVar("M")
_STEP_S = 1 / 30
_HISTORY_S = 30.0
"""Length of the actions and of the TCP's trail shown after a jump."""
_MOST_HISTORY = 300
_FRESH_S = 1.0
"""Maximum age of a report; modules report five times a second."""
_WHOLE = ("action", "ee_pose")
"""Topics whose every message is delivered; of others only the newest in each step."""


class RecordedSource:
    """Source of a view of one run. Nothing is connected to ROS and nothing is sent.

    Args:
        run: name of the run.
        files: its MCAP files.
        config: used if the run does not hold the configuration of its robot.
        registry: installed plugins; must include the recorded robot's.
        clock: for the playback [s].

    Raises:
        InvalidInputError: the run has no messages.
        OSError: it cannot be read.
    """

    label = "recorded"
    records = None

    def __init__(
        self,
        run: str,
        files: Sequence[Path],
        config: Config,
        registry: Registry,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._timeline = Timeline(files)
        self._log = RunLog(self._timeline)
        self._registry = registry
        self._config = _recorded_config(self._timeline.about, config)
        begin_ns, end_ns = self._timeline.begin_ns, self._timeline.end_ns
        self.playback = Playback(run, begin_ns / 1e9, (end_ns - begin_ns) / 1e9, self._log.marks)
        self._lock = threading.RLock()
        """Guards the timeline and the fields below, used by the threads of the pages and of the
        playback.
        """
        self._callbacks: dict[str, list[Callable[[Any], None]]] = {}
        self._shown_ns = begin_ns
        self._message_s = 0.0
        self._delivering = 0
        self._reports: dict[tuple[int, int], list[tuple[str, Report]]] = {}
        self._unusable: set[str] = set()
        self._unchecked = UncheckedPaths()
        self._clock = clock
        self._stepped_s = clock()
        self._player = Periodic("view-playback", _STEP_S, self.step)

    def open(self) -> None:
        """Start the playback thread."""
        self._player.start()

    def close(self) -> None:
        """Stop the playback thread; idempotent."""
        self._player.close()

    @property
    def shown_events(self) -> _EventsUntil:
        """See Source: events up to the time shown."""
        return _EventsUntil(self._log.lines(self._shown_ns))

    def config(self) -> Config:
        """See Source."""
        return self._config

    def profile(self) -> RobotProfile:
        """See Source."""
        return robot_profile(self._config, self._registry)

    def now_s(self) -> float:
        """See Source."""
        return (
            self._message_s if threading.get_ident() == self._delivering else self._shown_ns / 1e9
        )

    def snapshot(self) -> PageState:
        """See Source."""
        with self._lock:
            at_ns = self._shown_ns
            reports = self._reports_at(at_ns)
            latched, cause = self._log.stop(at_ns)
            told, control = reports.get("inference"), reports.get("control")
            metrics = {} if control is None else control.metrics
            robot = reports.get("robot")
            return PageState(
                modules=tuple(
                    self._row(kind, reports.get(kind), at_ns)
                    for kind in dict.fromkeys((*MODULE_KINDS, *reports))
                ),
                is_latched=latched,
                cause=cause,
                instruction=(told.instruction if told is not None else "")
                or self._log.instruction(at_ns),
                limit=metrics.get("limit", ""),
                limit_counts=limit_counts(metrics),
                unchecked=self._unchecked.why(
                    self._config, self._registry, {} if robot is None else robot.metrics, metrics
                ),
            )

    @property
    def release_command(self) -> str:
        """See Source. Empty: a recording has no stop."""
        return ""

    def is_latched(self) -> bool:
        """See Source."""
        return False

    def poll(self) -> None:
        """See Source. Does nothing, because all events have been read already."""

    def subscribe(
        self, message_type: type[M], topic: str, callback: Callable[[M], None]
    ) -> Callable[[], None]:
        """See Source."""
        place = f"/{self._config.namespace}/{topic}"
        with self._lock:
            if (
                place not in self._timeline.topics
                and f"{place}/compressed" in self._timeline.topics
            ):
                place += "/compressed"
            self._callbacks.setdefault(place, []).append(callback)
        return lambda: self._callbacks[place].remove(callback)

    def press_stop(self, who: str) -> str:
        """See Source. Always raises; the page of a recording has no such button."""
        raise StateError(
            "This page plays a recording; it cannot stop a robot.", hint="Use roboneuron estop."
        )

    def step(self) -> None:
        """Deliver the messages that are due."""
        now_s = self._clock()
        elapsed_s, self._stepped_s = now_s - self._stepped_s, now_s
        if not any(self._callbacks.values()):
            return  # no page is open
        self._delivering = threading.get_ident()
        position_s, jumped = self.playback.advance(elapsed_s)
        with self._lock:
            until_ns = self._timeline.begin_ns + round(position_s * 1e9)
            before_ns, self._shown_ns = self._shown_ns, until_ns
            if jumped:
                self.playback.tell_jump()
            for topic, callbacks in self._callbacks.items():
                for record in self._due(topic, before_ns, until_ns, jumped) if callbacks else ():
                    self._deliver(record, callbacks)
            self._message_s = until_ns / 1e9

    def _due(self, topic: str, before_ns: int, until_ns: int, jumped: bool) -> list[Record]:
        """Messages that are due on a topic, oldest first."""
        if topic.rpartition("/")[2] in _WHOLE:
            since_ns = until_ns - round(_HISTORY_S * 1e9) if jumped else before_ns
            found = list(self._timeline.between(topic, since_ns, until_ns))
            step = 1 + len(found) // _MOST_HISTORY
            return found[::-1][::step][::-1]
        newest = self._timeline.newest(topic, until_ns)
        is_new = newest is not None and (jumped or newest.log_ns > before_ns)
        return [newest] if newest is not None and is_new else []

    def _deliver(self, record: Record, callbacks: Sequence[Callable[[object], None]]) -> None:
        if record.topic in self._unusable:
            return
        try:
            message = self._timeline.decode(record)
            if record.type.endswith("Image"):
                message = _as_image(message, record)
        except (InvalidInputError, ValueError) as error:
            self._unusable.add(record.topic)
            log.warning("Cannot show %s: %s", record.topic, error)
            return
        self._message_s = record.log_ns / 1e9
        for callback in list(callbacks):
            callback(message)

    def _reports_at(self, at_ns: int) -> dict[str, Report]:
        """Newest report of each module by kind, without those that are too old."""
        found: dict[str, Report] = {}
        seen: dict[tuple[int, int], list[tuple[str, Report]]] = {}
        for record in self._timeline.between("/diagnostics", at_ns - round(_FRESH_S * 1e9), at_ns):
            key = (record.log_ns, record.sequence)
            told = seen[key] = self._reports.get(key) or self._read_reports(record)
            found.update(told)
        self._reports = seen
        return found

    def _read_reports(self, record: Record) -> list[tuple[str, Report]]:
        read: list[tuple[str, Report]] = []
        for status in self._timeline.decode(record).status:
            namespace, _, node = status.name.strip("/").rpartition("/")
            values = {pair.key: pair.value for pair in status.values}
            if namespace == self._config.namespace and {"state", "ready"} <= values.keys():
                read.append(
                    (
                        node.removesuffix("_b"),
                        Report.from_values(values, received_s=record.log_ns / 1e9),
                    )
                )
        return read

    def _row(self, kind: str, report: Report | None, at_ns: int) -> ModuleRow:
        health, why = self._log.health(kind, at_ns)
        chosen = self._log.chosen(kind, at_ns)
        if report is None:
            return ModuleRow(kind=kind, health=health or "stopped", text=why, chosen=chosen)
        assessed = ModuleView(kind=kind, phase="running", report=report).health(at_ns / 1e9)
        error = why or report.error
        return module_row(kind, health or assessed, report, error=error, chosen=chosen)


class _EventsUntil:
    """Events up to a time, oldest first."""

    def __init__(self, events: list[ShownEvent]) -> None:
        self._events = events
        self.count = len(events)

    def newest(self, most: int) -> list[ShownEvent]:
        """The newest events, newest first."""
        return self._events[: -most - 1 : -1]


def _recorded_config(about: dict[str, str], config: Config) -> Config:
    """Configuration of the run; if the run does not hold one, `config` with the recorded robot.

    Raises:
        InvalidInputError: the run does not name its robot either.
    """
    try:
        told = foreign.decode_json(about["config"], "the configuration", has_constants=True)
        found = foreign.to_model(Config, told, "the configuration")
    except (KeyError, ForeignDataError):
        if "robot" not in about:
            raise InvalidInputError("The run does not name its robot.") from None
        log.warning(
            "The run does not hold its configuration; the limits shown are those configured now."
        )
        robot = config.robot.model_copy(update={"name": about["robot"]})
        found = config.model_copy(update={"robot": robot})
    namespace = about.get("namespace") or found.namespace
    return found.model_copy(
        update={"robot": found.robot.model_copy(update={"namespace": namespace})}
    )


def _as_image(message: object, record: Record) -> object:
    """Convert a recorded image to the image message of its camera."""
    from sensor_msgs.msg import Image  # heavy

    pixels = pixels_of(message, record.type)
    height, width = pixels.shape[:2]
    image = Image(width=width, height=height, step=3 * width, encoding="rgb8")
    image.data = pixels.tobytes()
    stamp_ns = stamp_of(record.data)
    image.header.stamp.sec, image.header.stamp.nanosec = divmod(stamp_ns, 1_000_000_000)
    return image
