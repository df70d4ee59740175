"""Who moves the arm, as control knows it: the policy, a person who leads it, both, or nobody."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from rn_standard.teleoperation.rows import LeadRow

Who = Literal["policy", "person", "blend", "nobody"]
SILENT_S = 0.12
"""A lead without rows for so long holds the arm: with the braking it stands within 0.2 s."""
LOST_S = 1.0
"""A lead that is silent for so long is over, and motion needs a new start."""


@dataclass(kw_only=True, slots=True)
class Authority:
    """Decides by the rows of leads as they come, and by their absence. Knows no clock.

    Attributes:
        row: the newest row of the lead; None without a lead.
        released_ns: actions of the policy that were sent before are those of before the hand-back
            [ROS time, ns].
    """

    row: LeadRow | None = None
    released_ns: int = 0
    _row_s: float = 0.0
    _must_release: bool = False
    _ended: str = ""

    @property
    def who(self) -> Who:
        """Who may move the arm now."""
        if self.row is None:
            return "policy"
        if self._must_release:
            return "nobody"
        return "blend" if self.row.mode == "blend" else "person"

    def take(self, row: LeadRow, now_s: float) -> str:
        """Take in a row; a word for why it does not count, or empty.

        Args:
            row: as it came.
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
        """The lead is over; the policy acts again, from its next action on."""
        if self.row is not None:
            self._ended = self.row.session
        self.row, self.released_ns, self._must_release = None, now_ns, False

    def look(self, now_s: float) -> Literal["", "silent", "lost"]:
        """Whether a lead is silent: the arm has to hold; or lost."""
        if self.row is None:
            return ""
        silent_s = now_s - self._row_s
        if silent_s > LOST_S:
            return "lost"
        if silent_s > SILENT_S:
            self._must_release = True
            return "silent"
        return ""

    def why_no_policy(self, source_ns: int) -> str:
        """Word for why an action of the policy is not executed; empty when it is.

        Args:
            source_ns: when it was sent [ROS time, ns].
        """
        if self.row is None:
            return "before_hand_back" if source_ns < self.released_ns else ""
        return "" if self.who == "blend" else "taken_over"
