"""Checks of a new module in shadow before the handover, and of its first output; one class per
kind.
"""

from __future__ import annotations

import statistics
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar

from roboneuron.contract import ACTION_LABEL, GRIPPER, channel_keys
from roboneuron.errors import NotReadyError, RefusedError
from roboneuron.modules.report import Report
from roboneuron.modules.settings import ModuleKind
from roboneuron.planning import KIND_ENTRIES, Plan
from roboneuron.server.loop import ClosedLoop
from roboneuron.switching.gap import Gap, action_gap

_LOOKS = 3
"""Number of shadow actions to compare: reports come every 0.2 s. Control compares in its own
process.
"""
_SHADOW_S = 5.0
_RECENT_NS = 1_000_000_000
"""Age from which a sent action has ended."""
_WITHOUT_INPUT = ("no_action", "stale_joint_state")
"""Reasons to hold that are not the controller's: the policy or the robot pauses. In shadow control
reports none.
"""
Shadow = Callable[[], Report]
"""Returns the newest report of the new module; raises its error or that of the old one."""


class SwitchCheck(ABC):
    """One switch of one kind; used once, on the caller's thread.

    Attributes:
        kind: kind of the modules.
    """

    kind: ClassVar[ModuleKind]

    def __init__(self, loop: ClosedLoop, plan: Plan) -> None:
        self._loop = loop
        self._modules = loop.modules
        self._config = plan.config

    @property
    def noun(self) -> str:
        """Word for the content of such a module, for messages."""
        return KIND_ENTRIES[self.kind].noun

    @abstractmethod
    def compare(self, shadow: Shadow) -> float | None:
        """Difference between the new and the old module [m or rad]; None if unknown.

        Raises:
            RefusedError: the difference is too large.
            NotReadyError: the new module produces nothing.
        """

    @abstractmethod
    def has_taken_over(self, new: Report) -> bool:
        """True if the first output after the moment was sent."""

    @abstractmethod
    def measure(self, old: Report | None, new: Report | None) -> Gap | None:
        """Gap between the last output of the old and the first of the new module; None while
        unknown.
        """

    def is_due(self) -> bool:
        """True if an output must follow the moment; called once, right before it."""
        return True

    def latency_s(self, new: Report) -> float:
        """Time from an input to its output [s]."""
        return (new.latency_p99_ms or new.latency_ms or 0.0) / 1e3

    def has_rows(self) -> bool:
        """True if the old module has more to send after the moment, for inputs from before it."""
        return False

    def old(self) -> Report | None:
        """The newest report of the working module."""
        return self._modules.slot(self.kind).report


class InferenceCheck(SwitchCheck):
    """Compares shadow actions with those on the topic; the first action confirms the handover."""

    kind = "inference"

    def __init__(self, loop: ClosedLoop, plan: Plan) -> None:
        super().__init__(loop, plan)
        self._stream = loop.stream(plan.config.namespace)
        section = plan.config.inference
        assert section is not None
        self._bound = section.switch_max_difference
        self._has_instruction = bool(section.instruction)

    def compare(self, shadow: Shadow) -> float | None:
        """See `SwitchCheck.compare`."""
        if not self._has_instruction:
            return None
        started_ns = time.time_ns()
        seen: dict[str, tuple[float, ...]] = {}
        label = [ACTION_LABEL]

        def enough() -> bool:
            report = shadow()
            if "shadow_count" in report.metrics:
                label[0] = report.metrics.get("space", ACTION_LABEL)
                values = tuple(
                    float(report.metrics[f"shadow_action.{name}"])
                    for name in channel_keys(label[0])
                )
                seen[report.metrics["shadow_count"]] = values
            return len(seen) >= _LOOKS

        if not self._modules.changes.wait_for(enough, _SHADOW_S) and not seen:
            raise NotReadyError(
                f"The new backend predicted nothing within {_SHADOW_S:g} s in shadow; nothing was "
                "replaced.",
                hint="Do images come? See get_status.",
            )
        old = self.old()
        if old is not None and old.metrics.get("space", ACTION_LABEL) != label[0]:
            return None  # positions and deltas cannot be compared
        sent = [values for sent_ns, values in self._stream.copy() if sent_ns >= started_ns]
        difference = _difference(list(seen.values()), sent, channel_keys(label[0]))
        if difference is not None and difference > self._bound:
            raise RefusedError(
                f"In shadow the new backend's actions differ by {difference:.3g} m or rad from "
                "those of the running "
                f"one, at most {self._bound:g} is allowed; nothing was replaced.",
                hint="Check that both were made for this robot, or raise switch_max_difference in "
                "[inference].",
                rule="switch",
            )
        return difference

    def latency_s(self, new: Report) -> float:
        """See `SwitchCheck.latency_s`; the old module's rows also bridge the wait for an image."""
        return super().latency_s(new) + (_period_s(self.old()) or 0.0)

    def has_rows(self) -> bool:
        """True for the rest of a chunk."""
        return _number(self.old(), "chunk_rows") > 1

    def is_due(self) -> bool:
        """False without an instruction, because nothing is sent."""
        return self._has_instruction

    def has_taken_over(self, new: Report) -> bool:
        """See `SwitchCheck.has_taken_over`."""
        return "first_sent_ns.action" in new.metrics

    def measure(self, old: Report | None, new: Report | None) -> Gap | None:
        """See `SwitchCheck.measure`."""
        first_ns = _number(new, "first_sent_ns.action")
        return action_gap([at for at, _ in self._stream.copy()], first_ns) if first_ns else None


class PerceptionCheck(SwitchCheck):
    """Checks that images have the size known to the backend; one of each camera confirms the
    handover.
    """

    kind = "perception"

    def compare(self, shadow: Shadow) -> float | None:
        """See `SwitchCheck.compare`; images are not compared, so there is no number."""
        sizes, before = _by_camera(shadow(), "size."), _by_camera(self.old(), "size.")
        if self._modules.view("inference").phase != "running":
            return None
        for camera in sizes.keys() & before.keys():
            if sizes[camera] != before[camera]:
                raise RefusedError(
                    f"The new source's images of camera {camera!r} are {sizes[camera]} pixels "
                    "large, those of the "
                    f"running one {before[camera]}; the backend would not act on them. Nothing "
                    "was replaced.",
                    hint="Configure the new source for that size, or stop_inference first.",
                    rule="switch",
                )
        return None

    def latency_s(self, new: Report) -> float:
        """A source is not late because it delivers the next image slowly."""
        return max(super().latency_s(new), _period_s(self.old()) or 0.0)

    def has_taken_over(self, new: Report) -> bool:
        """See `SwitchCheck.has_taken_over`."""
        return _by_camera(new, "size.").keys() == _by_camera(new, "first_sent_ns.").keys()

    def measure(self, old: Report | None, new: Report | None) -> Gap | None:
        """Gap of the camera with the longest one."""
        first, last, period_s = (
            _by_camera(new, "first_sent_ns."),
            _by_camera(old, "last_sent_ns."),
            _period_s(old),
        )
        gaps = [
            (int(first[camera]) - int(last[camera])) / 1e9 for camera in first.keys() & last.keys()
        ]
        return Gap(gap_s=max(gaps), period_s=period_s) if gaps and period_s else None


class ControlCheck(SwitchCheck):
    """Compares poses and commands with those of the old controller; the first command, or a pose,
    confirms the handover.
    """

    kind = "control"

    def __init__(self, loop: ClosedLoop, plan: Plan) -> None:
        super().__init__(loop, plan)
        section = plan.config.control
        assert section is not None
        self._bound = section.switch_max_difference
        self._is_commanding = False

    def compare(self, shadow: Shadow) -> float | None:
        """See `SwitchCheck.compare`."""
        commanding = self._commands()

        def enough() -> bool:
            metrics = shadow().metrics
            return "shadow_tcp_difference" in metrics and (
                not commanding or int(metrics.get("shadow_compared", "0")) >= _LOOKS
            )

        complete = self._modules.changes.wait_for(enough, _SHADOW_S)
        metrics = shadow().metrics
        if "shadow_tcp_difference" not in metrics:
            raise NotReadyError(
                "The new controller and the running one did not report a pose for the same joint "
                "state within "
                f"{_SHADOW_S:g} s; nothing was replaced.",
                hint="Do joint states come, and does control publish ee_pose? See get_status.",
            )
        self._check("TCP poses", float(metrics["shadow_tcp_difference"]), "m or rad")
        if commanding and not complete and self._commands():
            if metrics.get("shadow_hold"):
                raise RefusedError(
                    "The new controller would hold where the running one moves the arm: "
                    f"{metrics['shadow_hold']}. "
                    "Nothing was replaced.",
                    rule="switch",
                )
            raise NotReadyError(
                f"The new controller answered too few actions within {_SHADOW_S:g} s in shadow; "
                "nothing was replaced.",
                hint="See its log.",
            )
        if not commanding or "shadow_difference" not in metrics:
            return float(metrics["shadow_tcp_difference"])
        difference = float(metrics["shadow_difference"])
        self._check("commands", difference, "rad or m")
        return difference

    def is_due(self) -> bool:
        """A pose is always due; a command only if the old controller commands the arm."""
        self._is_commanding = self._commands()
        return True

    def has_taken_over(self, new: Report) -> bool:
        """See `SwitchCheck.has_taken_over`; a controller without an action since then holds the
        arm, which confirms it.
        """
        told = new.metrics
        holds = told.get("hold_code") in _WITHOUT_INPUT and "compute_ms" not in told
        rests = not self._is_commanding and "first_sent_ns.pose" in told
        return "first_sent_ns.command" in told or holds or rests

    def measure(self, old: Report | None, new: Report | None) -> Gap | None:
        """Gap of the commands; None while the arm rests."""
        first_ns, last_ns = (
            _number(new, "first_sent_ns.command"),
            _number(old, "last_sent_ns.command"),
        )
        if not (first_ns and last_ns and old is not None and old.rate_hz):
            return None
        return Gap(gap_s=(first_ns - last_ns) / 1e9, period_s=1.0 / old.rate_hz)

    def _check(self, what: str, difference: float, unit: str) -> None:
        if difference > self._bound:
            raise RefusedError(
                f"The new controller's {what} differ by {difference:.3g} {unit} from those of the "
                "running one, at most "
                f"{self._bound:g} is allowed; nothing was replaced.",
                hint="Check that both are set up for this arm, or raise switch_max_difference in "
                "[control].",
                rule="switch",
            )

    def _commands(self) -> bool:
        """True if the running control moves the arm now."""
        return abs(time.time_ns() - _number(self.old(), "last_sent_ns.command")) < _RECENT_NS


CHECKS: Mapping[ModuleKind, type[SwitchCheck]] = {
    check.kind: check for check in (InferenceCheck, PerceptionCheck, ControlCheck)
}
"""Checks by kind of replaceable module."""


def _difference(
    shadow: Sequence[tuple[float, ...]],
    acting: Sequence[tuple[float, ...]],
    keys: Sequence[str],
) -> float | None:
    """Largest difference of the medians over the channels, in their own units; grippers are
    ignored.
    """
    if not shadow or not acting:
        return None
    return max(
        abs(statistics.median(a[axis] for a in shadow) - statistics.median(a[axis] for a in acting))
        for axis, key in enumerate(keys)
        if not key.endswith(GRIPPER)
    )


def _number(report: Report | None, key: str) -> int:
    return int(report.metrics.get(key, "0")) if report is not None else 0


def _by_camera(report: Report | None, prefix: str) -> dict[str, str]:
    if report is None:
        return {}
    return {
        key.removeprefix(prefix): value
        for key, value in report.metrics.items()
        if key.startswith(prefix)
    }


def _period_s(report: Report | None) -> float | None:
    """Time between two images of one camera [s]."""
    if report is None or not report.rate_hz:
        return None
    return len(_by_camera(report, "last_sent_ns.")) / report.rate_hz
