"""Faults of the controller, as text. Pure computation."""

from __future__ import annotations

from collections.abc import Mapping

from rn_driver_ros2control.link import ControllerReport, End, MeasuredJoint
from rn_driver_ros2control.options import Ros2ControlOptions
from roboneuron import JointKinds

FAULTS = (
    End.PATH_TOLERANCE,
    End.GOAL_TOLERANCE,
    End.PREEMPTED,
    End.CANCELLED,
    End.ABORTED,
    End.LOST,
)
"""Ends of a goal that require attention."""


_CAUSES = {
    "preempt": "another client sends goals",
    "deactivat": "the controller was deactivated",
}
"""Causes by words of the controller's message; without a message it may be any."""


def worded(end: End, text: str) -> str:
    """Text of the fault for the end of a goal; `text` is the controller's message."""
    said = f" ({text})" if text else ""
    if end is End.CANCELLED:
        return f"another client has cancelled the goal{said}"
    if end is End.LOST:
        return f"the controller has lost the goal{said}"
    if end is End.ABORTED:
        causes = [cause for word, cause in _CAUSES.items() if word in text.lower() or not text]
        return f"the goal was aborted{said}{': ' * bool(causes)}{', or '.join(causes)}"
    return f"{end.value}{said}"


def violation(
    report: ControllerReport,
    joints: Mapping[str, MeasuredJoint],
    goal: Mapping[str, float],
    late_s: float,
    options: Ros2ControlOptions,
    kinds: JointKinds,
) -> str:
    """The fault if a tolerance of the options is violated; empty if none is.

    Args:
        report: newest report of the controller.
        joints: measured.
        goal: target by joint [rad or m].
        late_s: time since the target was due [s].
        options: a tolerance of 0 is the controller's own.
        kinds: of the joints.
    """
    fault = ""
    if options.path_tolerance:
        off = {name: abs(error) for name, error in report.error.items()}
        fault = _worst(End.PATH_TOLERANCE, off, options.path_tolerance)
    is_due = 0.0 < options.goal_time_tolerance_s < late_s
    if is_due and options.goal_tolerance and not fault:
        off = {
            name: abs(kinds.difference(name, joints[name].position, place))
            for name, place in goal.items()
        }
        fault = _worst(End.GOAL_TOLERANCE, off, options.goal_tolerance)
    return fault


def _worst(end: End, off: Mapping[str, float], bound: float) -> str:
    worst = max(off, key=lambda name: off[name], default="")
    if not worst or off[worst] <= bound:
        return ""
    return f"{end.value}: {worst} is {off[worst]:.3g} off, allowed are {bound:g}"
