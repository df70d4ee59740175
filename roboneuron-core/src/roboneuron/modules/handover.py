"""Handover between two modules of one kind at a moment in the time of their inputs.

Both modules are active on the same topics. Inputs stamped before the moment belong to the old module, later ones to the
new module, so nothing is acted on twice and nothing is left out, however long the messages about it take. Before the
handover, the new module works in shadow: it processes live inputs and publishes nothing. Inference compares the capture
time of images, perception the capture time of its own images, control the times at which actions were sent and joints
measured.

A moment is a ROS time only for as long as messages from before it may still be on their way. After that it is past for
good, by the monotonic clock: otherwise a clock that is set back would put a module into shadow again.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence

from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from roboneuron.modules.settings import ACT_FROM, ACT_UNTIL, HANDOVER_PARAMETERS, NEVER_NS, PLAY_UNTIL

_SETTLE_S = 5.0
"""A moment is past for good so long after it: whatever was stamped before it has arrived or is too old to act on."""
_FARTHEST_S = 10.0
"""A moment farther ahead than this was made before the clock was set."""


class Handover:
    """The three moments of a handover; read by the module's threads, set by the executor's.

    Args:
        now_ns: ROS time [ns].
        now_s: monotonic time [s].
    """

    def __init__(self, now_ns: Callable[[], int] = time.time_ns, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_ns = now_ns
        self._now_s = now_s
        self._moments_ns = dict.fromkeys(HANDOVER_PARAMETERS, 0)
        self._past_s = dict.fromkeys(HANDOVER_PARAMETERS, math.inf)

    def serve(self, node: Node, *, shadow: bool) -> None:
        """Let the moments be set as parameters of `node`; does nothing the second time.

        Args:
            node: of a module without other parameters to check.
            shadow: the module starts in shadow.
        """
        if node.has_parameter(ACT_FROM):
            return
        node.add_on_set_parameters_callback(self._on_parameters)
        for name in HANDOVER_PARAMETERS:
            node.declare_parameter(name, NEVER_NS if shadow and name == ACT_FROM else 0)

    def _on_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        moments = [parameter for parameter in parameters if parameter.name in HANDOVER_PARAMETERS]
        refused = next((reason for moment in moments if (reason := self.check(moment))), "")
        if not refused:
            self.set(moments)
        return SetParametersResult(successful=not refused, reason=refused)

    def check(self, parameter: Parameter) -> str:
        """Why the parameter's value is no moment; empty when it is one."""
        if parameter.type_ is not Parameter.Type.INTEGER or parameter.value < 0:
            return f"{parameter.name} must be a ROS time in nanoseconds"
        return ""

    def set(self, parameters: Sequence[Parameter]) -> None:
        """Take over checked values."""
        for parameter in parameters:
            moment_ns = int(parameter.value)
            ahead_s = min(max(0.0, (moment_ns - self._now_ns()) / 1e9), _FARTHEST_S)
            is_moment = moment_ns not in (0, NEVER_NS)
            self._past_s[parameter.name] = self._now_s() + ahead_s + _SETTLE_S if is_moment else math.inf
            self._moments_ns[parameter.name] = moment_ns

    def is_shadow(self, stamp_ns: int) -> bool:
        """What is stamped `stamp_ns` is for looking only."""
        return stamp_ns < self._moments_ns[ACT_FROM] and self._now_s() < self._past_s[ACT_FROM]

    def is_over(self, stamp_ns: int) -> bool:
        """What is stamped `stamp_ns` is the successor's."""
        return self._has_come(ACT_UNTIL, stamp_ns)

    def is_ours(self, stamp_ns: int) -> bool:
        """What is stamped `stamp_ns` is to be acted on by this module."""
        return not self.is_shadow(stamp_ns) and not self.is_over(stamp_ns)

    def must_fall_silent(self, now_ns: int) -> bool:
        """The rest of a chunk is the successor's to replace."""
        return self._has_come(PLAY_UNTIL, now_ns)

    def _has_come(self, name: str, stamp_ns: int) -> bool:
        until_ns = self._moments_ns[name]
        return until_ns != 0 and (stamp_ns >= until_ns or self._now_s() >= self._past_s[name])
