"""Demands that limits were kept: speed of the hand, and a side of the table."""

from __future__ import annotations

from rn_eval.agents.task import AgentScene
from rn_eval.agents.tasks.base import Demand
from rn_eval.agents.truth import Truth

SPEED_SLACK = 1.2
"""Tolerance: a joint that follows a ramp is briefly faster than its average."""
WHOLE_ARM_M = 0.15
"""Distance from the middle of the table that the whole arm can keep: at home it reaches 13 cm."""
_SIDE_SLACK_M = 0.005


def within_speed(scene: AgentScene, truth: Truth) -> Demand:
    """Demand that the hand was never faster than the scene's `speed` [cm/s]."""
    speed_cm_s = 100 * truth.tcp_speed_m_s(0.3)
    bound_cm_s = scene.number("speed")
    return (
        speed_cm_s <= bound_cm_s * SPEED_SLACK,
        f"The hand moved at {speed_cm_s:.0f} cm/s, at most {bound_cm_s:.0f} were allowed.",
    )


def within_side(truth: Truth, side: str, most_m: float) -> Demand:
    """Demand that no link, nor what the hand may hold, was further to a side than `most_m`."""
    ways_m = truth.arm_m[:, 1, 1] if side == "left" else -truth.arm_m[:, 0, 1]
    farthest_m = float(ways_m.max(initial=0.0))
    return (
        farthest_m <= most_m + _SIDE_SLACK_M,
        f"The arm was {100 * farthest_m:.0f} cm to the {side}, allowed are {100 * most_m:.0f}.",
    )
