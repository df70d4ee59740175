"""Whose turn it is to act: a change-over between two inference modules is a moment in the images' time.

Both modules are active on the same topics. Images captured before the moment belong to the old one, later ones to the
new one, so that no image is acted on twice and none is left out, however long the messages about it take. Until its
turn comes, a module works in shadow: it predicts on live images and publishes nothing.
"""

from __future__ import annotations

from collections.abc import Sequence

from rclpy.parameter import Parameter

from roboneuron.modules.settings import ACT_FROM, ACT_UNTIL, PLAY_UNTIL, TURN_PARAMETERS


class Turn:
    """The three moments; read by the inference thread, set by the executor's."""

    def __init__(self) -> None:
        self._moments_ns = dict.fromkeys(TURN_PARAMETERS, 0)

    def check(self, parameter: Parameter) -> str:
        """Why the parameter's value is no moment; empty when it is one."""
        if parameter.type_ is not Parameter.Type.INTEGER or parameter.value < 0:
            return f"{parameter.name} must be a ROS time in nanoseconds"
        return ""

    def set(self, parameters: Sequence[Parameter]) -> None:
        """Take over checked values."""
        self._moments_ns |= {parameter.name: int(parameter.value) for parameter in parameters}

    def is_shadow(self, stamp_ns: int) -> bool:
        """An image captured at `stamp_ns` is for looking only."""
        return stamp_ns < self._moments_ns[ACT_FROM]

    def is_over(self, stamp_ns: int) -> bool:
        """An image captured at `stamp_ns` is the successor's."""
        until_ns = self._moments_ns[ACT_UNTIL]
        return until_ns != 0 and stamp_ns >= until_ns

    def must_fall_silent(self, now_ns: int) -> bool:
        """The rest of a chunk is the successor's to replace."""
        until_ns = self._moments_ns[PLAY_UNTIL]
        return until_ns != 0 and now_ns >= until_ns
