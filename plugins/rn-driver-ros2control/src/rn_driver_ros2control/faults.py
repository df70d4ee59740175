"""What counts as a fault of the controller, in words. Pure computation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rn_driver_ros2control.link import ControllerReport, End, Measured

FAULTS = (End.PATH_TOLERANCE, End.GOAL_TOLERANCE, End.PREEMPTED, End.CANCELLED, End.ABORTED)
"""Ends of a goal that somebody has to look at."""


def worded(end: End, text: str) -> str:
    """The fault that the end of a goal is; `text` is what the controller said."""
    said = f" ({text})" if text else ""
    if end is End.CANCELLED:
        return f"another client has cancelled the goal{said}"
    if end is End.ABORTED:
        return f"the goal was aborted{said}: another client sends goals, or the controller was deactivated"
    return f"{end.value}{said}"


def path_violation(report: ControllerReport, bound: float) -> str:
    """The fault when a joint follows worse than `bound` [rad or m]; empty when none does."""
    return _violation(End.PATH_TOLERANCE, {name: abs(error) for name, error in report.error.items()}, bound)


def goal_violation(names: Sequence[str], goal: Sequence[float], joints: Mapping[str, Measured], bound: float) -> str:
    """The fault when a joint is farther than `bound` [rad or m] from its goal; empty when none is."""
    off = {name: abs(joints[name].position - place) for name, place in zip(names, goal, strict=True)}
    return _violation(End.GOAL_TOLERANCE, off, bound)


def _violation(end: End, off: Mapping[str, float], bound: float) -> str:
    worst = max(off, key=lambda name: off[name], default="")
    if not worst or off[worst] <= bound:
        return ""
    return f"{end.value}: {worst} is {off[worst]:.3g} off, allowed are {bound:g}"
