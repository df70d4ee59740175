"""One profile, several drivers: an agent sees the same robot whichever driver moves it."""

from __future__ import annotations

import inspect

import pytest
from pydantic import ValidationError

from rn_robot_fr3.fci import state_topics
from rn_robot_fr3.plugin import roboneuron_robots
from rn_robot_fr3.profile import profile
from rn_simulation.scene_state import TOPIC
from rn_simulation.stepped import CLOCK_TOPIC, TURN_TOPIC
from roboneuron.plugins.availability import is_importable
from roboneuron.plugins.loading import load_options_model, load_target

SPEC = roboneuron_robots()[0]


def test_the_drivers_by_name():
    assert {"simulated", "ros2-control"} <= {driver.name for driver in SPEC.drivers}


@pytest.mark.parametrize("driver", SPEC.drivers, ids=lambda driver: driver.name)
def test_every_driver_takes_options_profile_and_topics(driver):
    for requirement in driver.requires:
        if not any(map(is_importable, (requirement.module, *requirement.alternatives))):
            pytest.skip(f"{requirement.module} is not installed: {requirement.install}")
    assert list(inspect.signature(load_target(driver)).parameters) == [
        "config",
        "profile",
        "topics",
    ]
    assert load_options_model(driver) is not None
    for method in ("open", "read", "send", "hold", "close"):
        assert callable(getattr(load_target(driver), method))


@pytest.mark.parametrize("driver", SPEC.drivers, ids=lambda driver: driver.name)
def test_time_waits_for_commands_in_a_simulation_alone(driver):
    for requirement in driver.requires:
        if not any(map(is_importable, (requirement.module, *requirement.alternatives))):
            pytest.skip(f"{requirement.module} is not installed: {requirement.install}")
    model = load_options_model(driver)
    if driver.name == "simulated":
        assert model.model_validate({"stepped": True}).stepped
    else:
        with pytest.raises(ValidationError, match="stepped"):
            model.model_validate({"stepped": True})


def test_the_topics_that_drivers_write_are_named_in_the_profile():
    names = (
        "MEASURED_JOINTS",
        "EXTERNAL_TORQUES",
        "EXTERNAL_WRENCH",
        "CURRENT_POSE",
        "ROBOT_STATE",
    )
    simulated = {TOPIC, CLOCK_TOPIC, TURN_TOPIC}
    written = simulated | {getattr(state_topics, name) for name in names}
    assert written == set(profile().own_topics)
