"""The arm tools need only the direct path, and are there as long as the robot's endpoints are
exposed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from roboneuron.direct_path.plugin import FEATURE as DIRECT_PATH
from roboneuron.errors import ConfigurationError
from roboneuron.plugins.specs import FeatureSpec
from roboneuron.server.app import Application
from roboneuron.tools.arm.plugin import FEATURE
from roboneuron.tools.ros.plugin import FEATURE as ROS_FEATURE

Make = Callable[..., Application]


@pytest.fixture
def make(application_of: Callable[..., Application]) -> Make:
    """Return a function that builds an application for the fake arm with some features."""

    def build(*features: FeatureSpec, text: str = "") -> Application:
        return application_of(DIRECT_PATH, *features, text=f'[robot]\nname = "gantry"\n{text}')

    return build


def names(application: Application) -> set[str]:
    return {tool.name for tool in application.tools.listing()}


def test_the_direct_path_alone_is_enough(make: Make) -> None:
    bare, with_arm = make(), make(FEATURE)
    # this robot exposes no trajectories
    assert names(with_arm) - names(bare) == {"move_ee", "pick", "place", "push"}


def test_an_arm_that_is_not_exposed_has_no_tools(make: Make) -> None:
    assert "move_ee" in names(make(FEATURE, ROS_FEATURE))
    assert "move_ee" not in names(make(FEATURE, ROS_FEATURE, text="[direct]\nprofile = false\n"))


def test_no_feature_exposes_what_is_kept_for_control(make: Make) -> None:
    gate = make().host.gate
    action = next(e for e in gate.exposed if e.hidden)
    with pytest.raises(ConfigurationError, match="written by RoboNeuron alone"):
        gate.expose("another", [replace(action, endpoint=replace(action.endpoint, name="mine"))])
    assert action in gate.exposed
