"""What stands between a module and its topics while it replaces another module or is replaced.

Modules know of a replacement by this one object: the predecessor, the shadow before the handover
and the successor after it are questions to it.
"""

from __future__ import annotations

from roboneuron.contract import Hold, JointCommand, Pose
from roboneuron.modules.status import StatusWriter


class Handover:
    """What a module asks about its inputs and tells of its outputs; the answers here are those of a
    module that nobody replaces.

    A feature puts its own into the module's process (`ModuleHost.handover`). Inputs are told apart
    by their time stamps [ROS time, ns]: capture times of images, times at which actions were sent
    and joints measured. Methods are called from any of the module's threads.
    """

    def __init__(self, status: StatusWriter) -> None:
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

    def withhold(self, output: JointCommand | Hold | Pose) -> None:
        """What the module would have sent for an input of the predecessor."""

    def note_sent(self, what: str) -> None:
        """An output of that name has gone out."""
