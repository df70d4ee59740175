"""`roboneuron view --robot NAME` takes the configuration and the folder of that robot."""

from __future__ import annotations

import pytest

from rn_fleet.plugin import FEATURE as FLEET
from rn_testing.fakes import fake_registry
from rn_view_attached.command import _chosen
from roboneuron import ConfigurationError
from roboneuron.config import parse_config

TWO = '[robots.left]\nrobot = {name = "gantry", namespace = "hall_2/a"}\n[robots.right]\nrobot = "gantry"\n'


def test_the_named_robot_is_shown() -> None:
    config, folder = _chosen(parse_config(TWO, registry=fake_registry(FLEET)), "left")
    assert config.namespace == "hall_2/a"
    assert folder == "robots/left"


def test_the_only_robot_of_a_server_needs_no_name() -> None:
    config, folder = _chosen(parse_config('[robot]\nname = "gantry"\n', registry=fake_registry()), None)
    assert (config.namespace, folder) == ("gantry", "")


@pytest.mark.parametrize(
    ("text", "robot", "expected"),
    [
        (TWO, None, "--robot names one of: left, right"),
        (TWO, "middle", "There is no robot 'middle'"),
        ('[robot]\nname = "gantry"\n', "left", "the configuration has no"),
    ],
)
def test_a_name_that_fits_nothing_is_refused_with_the_choices(text: str, robot: str | None, expected: str) -> None:
    with pytest.raises(ConfigurationError) as refused:
        _chosen(parse_config(text, registry=fake_registry(FLEET)), robot)
    assert expected in str(refused.value)
