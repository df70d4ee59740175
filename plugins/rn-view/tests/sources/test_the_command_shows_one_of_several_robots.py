"""`roboneuron view` takes the configurations of all robots, or of the one that is named."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Iterable

import pytest

from rn_standard.fleet.plugin import FEATURE as FLEET
from rn_testing.fakes import fake_registry
from rn_view_attached.command import _chosen, _sources
from roboneuron import ConfigurationError
from roboneuron.config import parse_config
from roboneuron.estop import ESTOP_FILE
from roboneuron.plugins.registry import Registry

TWO = (
    '[robots.left]\nrobot = {name = "gantry", namespace = "hall_2/a"}\n[robots.right]\nrobot = '
    '"gantry"\n'
)
LIVE = {"run": None, "directory": None}


def test_the_named_robot_is_shown() -> None:
    chosen = _chosen(parse_config(TWO, registry=fake_registry(FLEET)), "left")
    assert {name: config.namespace for name, config in chosen.items()} == {"left": "hall_2/a"}


def test_all_robots_can_be_shown_when_none_is_named() -> None:
    chosen = _chosen(parse_config(TWO, registry=fake_registry(FLEET)), None)
    assert {name: config.namespace for name, config in chosen.items()} == {
        "left": "hall_2/a",
        "right": "right",
    }


def test_the_only_robot_of_a_server_needs_no_name() -> None:
    chosen = _chosen(parse_config('[robot]\nname = "gantry"\n', registry=fake_registry()), None)
    assert {name: config.namespace for name, config in chosen.items()} == {"": "gantry"}


def plugins_of(robots: Iterable[str]) -> dict[str, Registry]:
    return dict.fromkeys(robots, fake_registry(FLEET))


def test_each_stop_is_that_of_its_robot(tmp_path) -> None:
    robots = _chosen(parse_config(TWO, registry=fake_registry(FLEET)), None)
    sources, graph = _sources(Namespace(state=tmp_path, **LIVE), robots, plugins_of(robots))
    sources["right"].press_stop("a visitor")
    assert (tmp_path / "robots" / "right" / ESTOP_FILE).exists()
    assert [source.snapshot().is_latched for source in sources.values()] == [False, True]
    assert graph.diagnostics is not None


@pytest.mark.parametrize(
    ("text", "robot", "expected"),
    [
        (TWO, "middle", "There is no robot 'middle'"),
        ('[robot]\nname = "gantry"\n', "left", "the configuration has no"),
    ],
)
def test_a_name_that_fits_nothing_is_refused_with_the_choices(
    text: str, robot: str | None, expected: str
) -> None:
    with pytest.raises(ConfigurationError) as refused:
        _chosen(parse_config(text, registry=fake_registry(FLEET)), robot)
    assert expected in str(refused.value)


def test_a_recording_is_of_one_robot() -> None:
    robots = _chosen(parse_config(TWO, registry=fake_registry(FLEET)), None)
    with pytest.raises(ConfigurationError, match="--robot names one of: left, right"):
        _sources(Namespace(run="latest", directory=None, state=None), robots, plugins_of(robots))
