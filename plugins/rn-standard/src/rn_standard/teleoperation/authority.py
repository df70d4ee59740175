"""Authority over the arm in control: the policy, a leading person, both, or none."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from rn_standard.teleoperation.rows import LeadRow

Who = Literal["policy", "person", "blend", "nobody"]
LATE_S, LATE_PERIODS = 0.05, 2.5
"""Time without rows after which the arm of a person is braked, at least as many periods of the
lead; it follows the next row again.
"""
SILENT_S = 0.12
"""Time without rows after which the switch has to be pressed again."""
LOST_S = 1.0
"""Silence after which a lead is over, and motion needs a new start."""


@dataclass(kw_only=True, slots=True)
class Authority:
    """Decides by the rows of leads and by their absence. Has no clock.

    Attributes:
        row: the newest row of the lead; None without a lead.
        released_ns: actions of the policy sent before this time belong to before the hand-back [ROS
            time, ns].
    """

    row: LeadRow | None = None
    released_ns: int = 0
    _row_s: float = 0.0
    _must_release: bool = False
    _ended: str = ""

    @property
    def who(self) -> Who:
        """The source that may move the arm now."""
        if self.row is None:
            return "policy"
        if self._must_release:
            return "nobody"
        return "blend" if self.row.mode == "blend" else "person"

    def take(self, row: LeadRow, now_s: float) -> str:
        """Process a row; return a word for the reason why it is ignored, or empty.

        Args:
            row: as received.
            now_s: monotonic.
        """
        before = self.row
        if row.session == self._ended:
            return "lead_ended"
        if before is not None and before.session != row.session:
            return "other_lead"
        if before is not None and row.number <= before.number:
            return "reordered_lead"
        if before is not None and now_s - self._row_s > SILENT_S:
            self._must_release = True
        self.row, self._row_s = row, now_s
        if row.kind == "rest":
            self._must_release = False
        return "lead_needs_release" if self._must_release and row.mode == "person" else ""

    def release(self, now_ns: int) -> None:
        """End the lead; the policy acts again, from its next action on."""
        if self.row is not None:
            self._ended = self.row.session
        self.row, self.released_ns, self._must_release = None, now_ns, False

    def look(self, now_s: float) -> Literal["", "late", "silent", "lost"]:
        """State of a silent lead: "late" or "silent" if the arm has to be braked, or "lost"."""
        if self.row is None:
            return ""
        silent_s = now_s - self._row_s
        if silent_s > LOST_S:
            return "lost"
        if silent_s > SILENT_S:
            self._must_release = True
            return "silent"
        late_s = max(LATE_S, LATE_PERIODS / self.row.rate_hz)
        return "late" if silent_s > late_s and self.row.mode == "person" else ""

    def why_no_policy(self, source_ns: int) -> str:
        """Word for the reason why an action of the policy is not executed; empty if it is.

        Args:
            source_ns: time at which it was sent [ROS time, ns].
        """
        if self.row is None:
            return "before_hand_back" if source_ns < self.released_ns else ""
        return "" if self.who == "blend" else "taken_over"
