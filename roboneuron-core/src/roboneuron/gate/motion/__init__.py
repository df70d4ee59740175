"""Limits on what control sends, between the controller's command and the publisher: pure computation, numpy only."""

from __future__ import annotations

from roboneuron.gate.motion.limiter import MotionLimiter
from roboneuron.gate.motion.rules import LIMITS, MotionRules, Zone, motion_rules
from roboneuron.gate.motion.verdict import Motion, Verdict

__all__ = ["LIMITS", "Motion", "MotionLimiter", "MotionRules", "Verdict", "Zone", "motion_rules"]
