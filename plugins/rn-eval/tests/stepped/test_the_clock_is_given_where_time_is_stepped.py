"""The feature gives its clock to tools and modules of a robot with the option `stepped` alone."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from rn_eval_stepped.chunks import SteppedRows
from rn_eval_stepped.feature import SteppedTimeFeature
from rn_eval_stepped.joining import join
from rn_eval_stepped.world import SteppedWorld
from rn_testing.fakes import fake_registry
from roboneuron import ConfigurationError, Feature
from roboneuron.config import Config, parse_config
from roboneuron.server.clock import RobotClock
from roboneuron.server.host import Host


def config(*, stepped: bool) -> Config:
    text = f'[robot]\nname = "gantry"\n[plugins.gantry]\nstepped = {str(stepped).lower()}\n'
    return parse_config(text, registry=fake_registry())


def host(feature: Feature[Any], *, stepped: bool) -> Any:
    """As much of a server as has a clock."""
    features = SimpleNamespace(loaded={"other": Feature(None), "stepped-time": feature})
    made: Any = SimpleNamespace(features=features, config=config(stepped=stepped))
    feature.tools(made)
    return made


@pytest.mark.parametrize("stepped", [True, False])
@pytest.mark.parametrize("is_own", [True, False])
def test_tools_of_the_own_robot_follow_one_clock(*, stepped: bool, is_own: bool) -> None:
    server = host(SteppedTimeFeature(None), stepped=stepped)
    space = server.config.namespace if is_own else "elsewhere"
    clock = Host.clock(server, space)
    if stepped and is_own:
        assert isinstance(clock, SteppedWorld)
        assert Host.clock(server, space) is clock, "it keeps its subscription"
    else:
        assert type(clock) is RobotClock


def test_two_clocks_of_one_robot_are_refused() -> None:
    server = host(SteppedTimeFeature(None), stepped=True)
    server.features.loaded["other"] = second = SteppedTimeFeature(None)
    second.tools(server)
    with pytest.raises(ConfigurationError, match="'other' and 'stepped-time'"):
        Host.clock(server, server.config.namespace)


@pytest.mark.parametrize("stepped", [True, False])
@pytest.mark.parametrize("kind", ["robot", "perception", "inference", "control"])
def test_modules_whose_steps_take_time_get_it(*, stepped: bool, kind: str) -> None:
    settings = SimpleNamespace(kind=kind, config=config(stepped=stepped))
    node: Any = SimpleNamespace(settings=settings, filters=[], on_configured=[])
    join(node)
    assert len(node.filters) == (stepped and kind == "inference")
    assert len(node.on_configured) == (stepped and kind == "control")
    assert all(isinstance(one, SteppedRows) for one in node.filters)
