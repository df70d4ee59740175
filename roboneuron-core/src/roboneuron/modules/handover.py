"""Which inputs are this module's, where a feature replaces running modules by others."""

from __future__ import annotations

from roboneuron.contract import ActionChunk, Hold, JointCommand, Pose
from roboneuron.modules.status import ModuleStatus


class Handover:
    """What a module asks about its inputs; the answers here are those of a module that nobody replaces.

    A feature puts its own into the module's process (`ModuleHost.handover`). Inputs are told apart by their time stamps
    [ROS time, ns]: capture times of images, times at which actions were sent and joints measured. Methods are called
    from any of the module's threads.

    Attributes:
        not_before_ns: images captured before it are not predicted on, not even in shadow.
    """

    not_before_ns = 0

    def __init__(self, status: ModuleStatus) -> None:
        """Args:
        status: where to report.
        """
        self.status = status

    def is_shadow(self, stamp_ns: int) -> bool:
        """Whether that input is still the predecessor's: work on it, and send nothing."""
        return False

    def is_over(self, stamp_ns: int) -> bool:
        """Whether that input is already the successor's."""
        return False

    def is_ours(self, stamp_ns: int) -> bool:
        """Whether this module is to act on that input."""
        return not self.is_shadow(stamp_ns) and not self.is_over(stamp_ns)

    def may_send(self, now_ns: int) -> bool:
        """Whether the predecessor has finished, so that this module may send its own."""
        return True

    def must_fall_silent(self, now_ns: int) -> bool:
        """Whether the successor replaces what is left of a chunk."""
        return False

    def withhold(self, output: ActionChunk | JointCommand | Hold | Pose) -> None:
        """What the module would have sent for an input of the predecessor."""

    def hear(self, output: JointCommand | Pose, sent_s: float) -> None:
        """What the predecessor has sent, and when [monotonic s]; called in shadow."""

    def note_sent(self, what: str) -> None:
        """An output of that name has gone out."""
