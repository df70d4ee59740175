"""The judges of arms: which controller they ask, and whose limits they know."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rn_testing.fakes import FAKE_CONTROLLER, fake_registry, gantry_profile
from roboneuron.config import LimitsConfig, parse_config
from roboneuron.contract import CollisionProfile, JointSample
from roboneuron.errors import ConfigurationError
from roboneuron.gate.motion.path_limits import Leg, LimitError
from roboneuron.modules.arm_paths import ArmPaths
from roboneuron.plugins.specs import ControllerSpec

PROFILE = gantry_profile()
CONTROLLED = '[robot]\nname = "gantry"\n[control]\ncontroller = "gantry"\n'
AT_ZERO = JointSample(names=PROFILE.arm_joints, position=np.zeros(6))


def leg(*position: float, duration_s: float = 1.0) -> Leg:
    return Leg(names=("slide_x",), position=np.array(position), duration_s=duration_s)


# The judges of arms


def paths(text: str = CONTROLLED, limits: LimitsConfig | None = None) -> ArmPaths:
    registry = fake_registry()
    return ArmPaths(
        parse_config(text), lambda: registry, None if limits is None else lambda: limits
    )


def test_a_judge_is_made_once_for_each_arm_until_its_limits_change() -> None:
    arms = paths()
    first = arms.limiter("gantry", PROFILE)
    assert arms.limiter("gantry", PROFILE) is first
    assert arms.limiter("another", PROFILE) is not first
    arms.forget()
    assert arms.limiter("gantry", PROFILE) is not first


def test_only_the_own_robot_has_the_limits_of_the_server() -> None:
    tight = LimitsConfig(max_speed_m_s=0.1)
    for arms in (paths(limits=tight), paths(CONTROLLED + "[limits]\nmax_speed_m_s = 0.1\n")):
        assert arms.rules("gantry", PROFILE).max_speed_m_s == 0.1
        assert arms.rules("another", PROFILE).max_speed_m_s == LimitsConfig().max_speed_m_s
        with pytest.raises(LimitError):
            arms.limiter("gantry", PROFILE).check([leg(0.4)], AT_ZERO)
        arms.limiter("another", PROFILE).check([leg(0.4)], AT_ZERO)


def test_a_controller_is_loaded_with_the_distances_in_force() -> None:
    watched = replace(PROFILE, collision=CollisionProfile(min_distance_m=0.01))
    controller, limited = paths(limits=LimitsConfig(min_distance_m=0.03)).load("gantry", watched)
    assert limited.collision is not None
    assert limited.collision.min_distance_m == 0.03
    assert controller.forward(AT_ZERO).position_m.tolist() == [0.0, 0.0, 0.0], "it is loaded"
    _, other = paths(limits=LimitsConfig(min_distance_m=0.03)).load("another", watched)
    assert other.collision is not None
    assert other.collision.min_distance_m == 0.01
    _, free = paths(limits=LimitsConfig(collision=False)).load("gantry", watched)
    assert free.collision is None


def test_an_arm_that_its_controller_cannot_move_has_no_judge() -> None:
    with pytest.raises(ConfigurationError, match="is no gantry"):
        paths().limiter("gantry", replace(PROFILE, arm_joints=("j1",)))


@pytest.mark.parametrize(
    ("specs", "text"), [((), "and none is installed"), (("b", "a"), "installed are a, b")]
)
def test_without_a_controller_in_the_configuration_there_must_be_just_one(
    monkeypatch: pytest.MonkeyPatch, specs: tuple[str, ...], text: str
) -> None:
    registry = fake_registry()
    monkeypatch.setattr(
        type(registry),
        "specs",
        lambda self, of: dict.fromkeys(specs) if of is ControllerSpec else {},
    )
    arms = ArmPaths(parse_config('[robot]\nname = "gantry"\n'), lambda: registry)
    with pytest.raises(ConfigurationError, match=f"would move 'gantry': .*{text}"):
        arms.limiter("gantry", PROFILE)
    with pytest.raises(ConfigurationError, match="would move 'gantry': "):
        arms.load("gantry", PROFILE)


def test_a_judge_is_of_the_only_controller_that_is_installed_now() -> None:
    registry = fake_registry()
    arms = ArmPaths(parse_config('[robot]\nname = "gantry"\n'), lambda: registry)
    before = arms.limiter("gantry", PROFILE)
    spare = fake_registry(replace(FAKE_CONTROLLER, name="spare"))
    others = tuple(offer for offer in spare.all_offers if offer.spec != FAKE_CONTROLLER)
    registry = replace(spare, all_offers=others)
    assert list(registry.specs(ControllerSpec)) == ["spare"]
    assert arms.limiter("gantry", PROFILE) is not before


def test_a_controller_is_made_with_its_options() -> None:
    options = "[plugins.gantry]\ngain = 2.0\n[plugins.another]\ngain = 2.0\n"
    with pytest.raises(ConfigurationError, match=r"gantry.*option"):
        paths(CONTROLLED + options).limiter("gantry", PROFILE)
    paths(CONTROLLED + options.replace("gantry", "third")).limiter("gantry", PROFILE)
