"""`[robots.<name>]`: a whole configuration for each robot, with what stands at the top level
shared.
"""

from __future__ import annotations

from argparse import Namespace

import pytest

from rn_standard.fleet.plugin import FEATURE
from rn_testing.fakes import fake_registry
from roboneuron.config import Config, parse_config
from roboneuron.errors import ConfigurationError
from roboneuron.plugins.specs import FeatureSpec
from roboneuron.selection.plugin import FEATURE as SELECTION

HTTP = FeatureSpec(
    name="wire",
    summary="A transport.",
    target="nowhere:Wire",
    config="rn_standard.http.options:HttpOptions",
    transports=("wire",),
)


def parse(text: str) -> Config:
    return parse_config(text, registry=fake_registry(SELECTION, FEATURE, HTTP))


def test_each_robot_has_what_is_its_own_and_what_all_share() -> None:
    config = parse("""
        [supervisor]
        state_directory = "/here"
        [limits]
        max_speed_m_s = 0.3
        [models.quick]
        backend = "instant"
        [wire]
        port = 4711
        [robots.left-arm]
        robot = "gantry"
        [robots.left-arm.inference]
        backend = "instant"
        [robots.left-arm.models.slow]
        backend = "instant"
        [robots.right]
        robot = {name = "gantry", namespace = "cell/right", driver = "other"}
        [robots.right.limits]
        max_speed_m_s = 0.1
    """)
    left, right = config.robots["left-arm"], config.robots["right"]
    assert (left.namespace, right.namespace) == ("left_arm", "cell/right")
    assert (left.robot.driver, right.robot.driver) == ("simulated", "other")
    assert (left.limits.max_speed_m_s, right.limits.max_speed_m_s) == (0.3, 0.1)
    assert left.inference is not None
    assert right.inference is None
    assert (list(left.sections["models"]), list(right.sections["models"])) == (
        ["quick", "slow"],
        ["quick"],
    )
    assert all(one.sections["wire"] == {"port": 4711} for one in (left, right, config))
    assert config.supervisor.state_directory == "/here"
    assert not left.robots
    assert not parse('[robot]\nname = "gantry"\n').robots


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            '[robot]\nname="gantry"\n[robots.a]\nrobot="gantry"',
            "either [robot] or [robots.<name>], not both",
        ),
        ("robots = 3", "robots = 3: expected tables"),
        ("[robots]", "expected tables [robots.<name>]"),
        ("[robots.a]", "[robots.a]: 'robot' is missing"),
        ("[robots.A]\nrobot='gantry'", "[robots.A]: a robot's name is made of"),
        ("[robots.a]\nrobot=3", "[robots.a]: robot.name = 3"),
        ("[robots.a]\nrobot='gantry'\n[robots.a.limit]\nx=1", "[robots.a]: unknown key 'limit'"),
        (
            "[robots.a]\nrobot='gantry'\n[robots.a.limits]\nmax_sped_m_s=1",
            "Did you mean 'max_speed_m_s'",
        ),
        (
            "[robots.a]\nrobot='gantry'\n[robots.a.server]\nname='x'",
            "'server' is shared by all robots",
        ),
        ("[robots.a]\nrobot='gantry'\n[robots.a.wire]\nport=1", "'wire' is shared by all robots"),
        (
            "[robots.a]\nrobot='gantry'\n[robots.a.supervisor]\nstate_directory='/x'",
            "'state_directory' is shared",
        ),
        (
            "[robots.a-b]\nrobot='gantry'\n[robots.a_b]\nrobot='gantry'",
            "two robots have the namespace 'a_b'",
        ),
        ("plugins = 3\n[robots.a]\nrobot='gantry'", "plugins = 3"),
    ],
)
def test_what_is_wrong_is_named_with_its_robot(text: str, expected: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        parse(text)
    assert expected in str(caught.value)
    assert str(caught.value).startswith("roboneuron.toml")


def test_the_command_line_speaks_of_the_server_of_all_robots() -> None:
    changed = parse_config(
        "[robots.a]\nrobot='gantry'\n[robots.b]\nrobot='gantry'",
        registry=fake_registry(FEATURE, HTTP),
        arguments=Namespace(transport="wire", host=None, port=99),
    )
    for one in (changed, *changed.robots.values()):
        assert one.server.transport == "wire"
        assert one.sections["wire"]["port"] == 99
    assert list(changed.robots) == ["a", "b"]


def test_without_the_feature_the_file_is_refused_with_what_to_install() -> None:
    with pytest.raises(
        ConfigurationError,
        match=r"\[robots\.<name>\]: There is no feature 'fleet'.*requirements\.txt",
    ):
        parse_config("[robots.a]\nrobot='gantry'", registry=fake_registry(HTTP))
