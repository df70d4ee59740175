"""Limits in a configuration are within the profile's."""

from __future__ import annotations

import pytest

from roboneuron.contract import Endpoint
from roboneuron.errors import ConfigurationError
from roboneuron.tools.ros.tightening import ConfiguredLimits, tighten


def test_a_configuration_can_only_tighten() -> None:
    velocity = Endpoint(
        name="velocity",
        kind="publish",
        topic="cmd_vel",
        type="geometry_msgs/msg/Twist",
        summary="Drive.",
        bounds={"linear.x": (-0.5, 0.5), "angular.z": (-1.0, 1.0)},
        rate_hz=5.0,
    )
    tight = tighten(
        velocity,
        ConfiguredLimits(bounds={"linear.x": (-0.1, 0.2), "linear.z": (0, 0)}, rate_hz=2.0),
    )
    assert tight.bounds["linear.x"] == (-0.1, 0.2)
    assert tight.bounds["angular.z"] == (-1.0, 1.0)
    assert tight.rate_hz == 2.0
    for wrong in (
        ConfiguredLimits(bounds={"linear.x": (-0.1, 0.6)}),
        ConfiguredLimits(bounds={"linear.x": (0.2, 0.1)}),
        ConfiguredLimits(bounds={"linear.x": (0.0, float("nan"))}),
        ConfiguredLimits(rate_hz=6.0),
        ConfiguredLimits(rate_hz=0.0),
        ConfiguredLimits(clamp=frozenset({"linear.z"})),
    ):
        with pytest.raises(ConfigurationError):
            tighten(velocity, wrong)
