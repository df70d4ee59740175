"""The data that a page shows, and the protocol of its source: a server, the ROS graph or a
recording.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Protocol, TypeVar

from rn_view.diagnostics.event_list import ShownEvents
from rn_view.recordings.playback import Playback
from rn_view.sources.records import RobotRecords
from roboneuron import RobotProfile
from roboneuron.feature import Config, ModuleKind, Registry, StillReason, load_profile

M = TypeVar("M")
MODULE_KINDS: tuple[ModuleKind, ...] = ("robot", "perception", "inference", "control")
"""Core's kinds, in the usual order of starting."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ModuleRow:
    """Row of the table of modules. Numbers are None if the module does not report them.

    Attributes:
        kind, health: kind of module, and a key of `roboneuron.feature.EXPLANATIONS`.
        text: its error, what it waits for, or its note.
        chosen: name of the plugin that it was started with, such as the backend.
        rate_hz, latency_ms, latency_p99_ms, age_ms: of its output.
        dropped: inputs not acted on.
    """

    kind: str
    health: str
    text: str = ""
    chosen: str = ""
    rate_hz: float | None = None
    latency_ms: float | None = None
    latency_p99_ms: float | None = None
    age_ms: float | None = None
    dropped: int = 0


class ReportedFacts(Protocol):
    """What the status of a module and its report have in common; see `ModuleRow`."""

    @property
    def waiting_for(self) -> str: ...

    @property
    def note(self) -> str: ...

    @property
    def metrics(self) -> Mapping[str, str]: ...

    @property
    def rate_hz(self) -> float | None: ...

    @property
    def latency_ms(self) -> float | None: ...

    @property
    def latency_p99_ms(self) -> float | None: ...

    @property
    def age_ms(self) -> float | None: ...

    @property
    def dropped(self) -> int: ...


def module_row(
    kind: str, health: str, facts: ReportedFacts, *, error: str = "", chosen: str = ""
) -> ModuleRow:
    """Row of a module that has reported. Its text is the error; else the input that it waits for;
    else its note.
    """
    waits = f"waits for {facts.waiting_for}" if facts.waiting_for else ""
    return ModuleRow(
        kind=kind,
        health=health,
        text=error or waits or note_text(facts.note, facts.metrics),
        chosen=chosen,
        rate_hz=facts.rate_hz,
        latency_ms=facts.latency_ms,
        latency_p99_ms=facts.latency_p99_ms,
        age_ms=facts.age_ms,
        dropped=facts.dropped,
    )


def chosen_plugin(started_with: Mapping[str, object]) -> str:
    """Name of the plugin that a module was started with, such as its backend; empty if unknown."""
    keys = ("robot", "source", "backend", "controller")
    return next((str(started_with[key]) for key in keys if key in started_with), "")


def robot_profile(config: Config, registry: Registry) -> RobotProfile:
    """Profile of the configured robot. Raises RoboNeuronError when its plugin cannot be used."""
    return load_profile(registry, config.robot)


_PARTS = {part: f"backend.shared.{part}_ms" for part in ("round_trip", "link", "queue", "model")}


def note_text(note: str, metrics: Mapping[str, str]) -> str:
    """Note of a module; for a policy on another machine, with the parts of the response time.

    Args:
        note: note of the module.
        metrics: metrics of its report.
    """
    try:
        whole, *parts = (f"{part} {float(metrics[key]):.0f}" for part, key in _PARTS.items())
    except (KeyError, ValueError):  # a local policy, or a module that does not report them
        return note
    split = f"{whole.replace('_', ' ')} ms: {', '.join(parts)}"
    return f"{note}; {split}" if note else split


@dataclass(frozen=True, kw_only=True, slots=True)
class PageState:
    """State of the robot at one moment.

    Attributes:
        modules: in the order of `MODULE_KINDS`, then those of kinds that features add.
        is_latched, cause: of the emergency stop; the cause says who pressed it and why.
        why_still: why the robot does not move, as far as the source knows, see `Host.why_still`.
        instruction: the present instruction of the policy.
        limit: control's message about the limit that acted last. After `ActiveLimits`: about the
            limit that acts now, empty if none does.
        limit_counts: number of times each limit has acted, by its name as in `[limits] on_<name>`.
        limits: names of the limits that act now, see `ActiveLimits`.
        unchecked: why places or distances are not checked, see `UncheckedPaths`; empty if they are.
    """

    modules: tuple[ModuleRow, ...] = ()
    is_latched: bool = False
    cause: str = ""
    why_still: tuple[StillReason, ...] = ()
    instruction: str = ""
    limit: str = ""
    limit_counts: Mapping[str, int] = field(default_factory=dict)
    limits: tuple[str, ...] = ()
    unchecked: str = ""


class Source(Protocol):
    """Data source of a page. Usable from any thread.

    Attributes:
        shown_events: the list of events.
        label: kind of view, shown on the page.
        playback: of a recording; None for a live robot. The page of a recording has no emergency
            stop.
        records: alarms, maintenance and past tasks; None outside the server.
    """

    @property
    def shown_events(self) -> ShownEvents: ...

    @property
    def label(self) -> str: ...

    @property
    def playback(self) -> Playback | None: ...

    @property
    def records(self) -> RobotRecords | None: ...

    def now_s(self) -> float:
        """Time of the data shown [s]: monotonic, or within a recording. In a callback of
        `subscribe` it is the time of the message.
        """
        ...

    def config(self) -> Config:
        """The configuration, with the robot that runs now."""
        ...

    def profile(self) -> RobotProfile:
        """Profile of the robot. Raises RoboNeuronError when its plugin cannot be used."""
        ...

    def snapshot(self) -> PageState:
        """State at the time shown."""
        ...

    @property
    def release_command(self) -> str:
        """Command with which a person releases the emergency stop, on the server's machine."""
        ...

    def is_latched(self) -> bool:
        """Whether the emergency stop is latched. Does not block; also called while no page is
        open.
        """
        ...

    def poll(self) -> None:
        """Read the audit and other files, and add to `shown_events`. Called a few times a
        second.
        """
        ...

    def subscribe(
        self, message_type: type[M], topic: str, callback: Callable[[M], None]
    ) -> Callable[[], None]:
        """Call `callback` with each message of a topic under the robot's namespace; returns a
        function that unsubscribes.

        Raises:
            RoboNeuronError: the ROS graph cannot be joined.
        """
        ...

    def press_stop(self, who: str) -> str:
        """Latch the emergency stop. Blocks until modules confirm it; returns a message that names
        them.

        Raises:
            RoboNeuronError: it could not be written or was not confirmed.
        """
        ...
