"""docs/safety.md: its example is a valid configuration, and its table names every limit with its
default.
"""

from __future__ import annotations

import re
from pathlib import Path

from rn_robot_fr3.profile import profile
from roboneuron.config import LimitsConfig, parse_config
from roboneuron.gate.motion import LIMITS, motion_rules

PAGE = (Path(__file__).parents[2] / "docs" / "safety.md").read_text()


def test_example_is_a_configuration_that_fits_the_robot() -> None:
    example = re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL)[0]
    config = parse_config('[robot]\nname = "fr3"\n' + example)
    rules = motion_rules(config.limits, profile())
    assert "monitor" in {zone.name for _, zone in rules.arm_zones}
    assert rules.max_speed_m_s == 0.25


def test_every_limit_is_listed_with_its_default_reaction() -> None:
    rows = dict(re.findall(r"^\| `(\w+)` \|.*\| (\w+) \|$", PAGE, re.MULTILINE))
    assert rows == {name: getattr(LimitsConfig(), f"on_{name}") for name in LIMITS}
