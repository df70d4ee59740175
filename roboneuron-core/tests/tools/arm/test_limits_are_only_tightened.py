"""What a client asks for is merged into something tighter, and never into something wider than
configured.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from roboneuron.config import LimitsConfig
from roboneuron.contract import (
    JointSample,
    LinkExtents,
    Pose,
    Posture,
    RobotProfile,
    Workspace,
)
from roboneuron.errors import ConfigurationError, InvalidInputError, RefusedError
from roboneuron.gate.motion import check_tighter, motion_rules
from roboneuron.tools.arm import limits_tools
from roboneuron.tools.arm.limits_tools import TightenLimits
from roboneuron.tools.arm.prediction import ArmControl
from roboneuron.tools.arm.tightening import TightenedRecord, Tightening, TighteningFile

PROFILE = RobotProfile(
    name="arm", workspace=Workspace(lower_m=np.full(3, -1.0), upper_m=np.full(3, 1.0))
)
CONFIGURED = LimitsConfig.model_validate(
    {
        "max_speed_m_s": 0.4,
        "acceleration_fraction": 0.8,
        "zones": [{"name": "post", "lower_m": [0.0, 0.0, 0.0], "upper_m": [0.1, 0.1, 0.1]}],
    }
)
numbers = st.none() | st.floats(-0.9, 0.9)
tightenings = st.builds(
    Tightening,
    max_speed_m_s=st.none() | st.floats(0.01, 3.0),
    acceleration=st.none() | st.floats(0.01, 1.0),
    x_min_m=numbers,
    y_max_m=numbers,
    z_min_m=numbers,
    keep_out=st.lists(
        st.just({"lower_m": [0.0, 0.0, 0.0], "upper_m": [0.5, 0.5, 0.5]}), max_size=1
    ).map(tuple),
    arm_keep_out=st.lists(
        st.just({"lower_m": [-100.0, 0.3, -100.0], "upper_m": [100.0, 100.0, 100.0]}), max_size=1
    ).map(tuple),
)


@given(tightenings, tightenings)
def test_no_sequence_of_calls_makes_the_limits_wider(first: Tightening, second: Tightening) -> None:
    before = first.applied(CONFIGURED, PROFILE)
    after = first.tighter(second).applied(CONFIGURED, PROFILE)
    check_tighter(before, CONFIGURED)
    check_tighter(after, before)


def test_each_number_keeps_its_tightest_value() -> None:
    both = Tightening(max_speed_m_s=0.2, y_max_m=0.3).tighter(
        Tightening(max_speed_m_s=0.3, y_max_m=0.0, z_min_m=0.1)
    )
    limits = both.applied(CONFIGURED, PROFILE)
    assert limits.max_speed_m_s == 0.2
    assert limits.workspace_lower_m == [-1.0, -1.0, 0.1]
    assert limits.workspace_upper_m == [1.0, 0.0, 1.0]
    assert [zone.name for zone in limits.zones] == ["post"]


def test_edges_for_the_whole_arm_are_what_lies_beyond_them() -> None:
    asked = TightenLimits(
        y_max_m=0.3, z_min_m=0.05, keep_out=[0.6, 0.6, 0.6, 0.4, 0.4, 0.0], applies_to="arm"
    )
    more = asked.tightening()
    assert (more.y_max_m, more.z_min_m, more.keep_out) == (None, None, ())
    limits = more.applied(CONFIGURED, PROFILE)
    assert limits.workspace_upper_m == [1.0, 1.0, 1.0]
    rules = motion_rules(limits, PROFILE)
    assert {box.name for _, box in rules.arm_zones} == {
        "kept out 1 by the arm",
        "y <= 0.3 m",
        "z >= 0.05 m",
    }
    assert [zone.name for zone in rules.zones] == ["post"]


def test_a_height_for_the_arm_does_not_make_the_tcps_workspace_the_arms() -> None:
    configured = CONFIGURED.model_copy(update={"applies_to": "arm", "min_height_m": 0.1})
    rules = motion_rules(Tightening(max_speed_m_s=0.1).applied(configured, PROFILE), PROFILE)
    assert [box.name for _, box in rules.arm_zones] == ["z >= 0.1 m"]
    assert rules.upper_m.tolist() == [1.0, 1.0, 1.0]


def test_it_is_told_how_far_now_and_home_are_beyond(monkeypatch: pytest.MonkeyPatch) -> None:
    arm = replace(PROFILE, arm_joints=("y",), home_rad=np.array([0.25]))

    class Slide:
        """An arm of one link, 0.2 m wide, that slides along y."""

        def inspect(self, joints: JointSample) -> Posture:
            middle = np.array([[0.5, joints.position[0], 0.5]])
            boxes = LinkExtents(names=("hand",), lower_m=middle - 0.1, upper_m=middle + 0.1)
            pose = Pose(position_m=middle[0], quaternion_xyzw=np.array([0.0, 0.0, 0.0, 1.0]))
            return Posture(pose=pose, extents=lambda: boxes)

        def close(self) -> None: ...

    slide: Any = Slide()
    anything: Any = None
    control = ArmControl(slide, anything, arm, anything)
    monkeypatch.setattr(ArmControl, "of", lambda host, exposed: control)
    here = JointSample(names=("y",), position=np.array([0.0]))
    gate = SimpleNamespace(
        exposed=[SimpleNamespace(profile=arm)], joints=lambda exposed, wait_s: here
    )
    host: Any = SimpleNamespace(gate=gate)
    more = TightenLimits(y_max_m=0.3, applies_to="arm").tightening()
    told = limits_tools.sticking_out(host, more.applied(CONFIGURED, arm))
    assert told == {"home": {"hand, y <= 0.3 m": 0.05}}
    of_tcp = Tightening(y_max_m=0.2).applied(CONFIGURED, arm)
    assert limits_tools.sticking_out(host, of_tcp) == {"home": {"the TCP, y <= 0.2 m": 0.05}}
    assert limits_tools.sticking_out(host, CONFIGURED) == {}


def test_a_wider_request_changes_nothing() -> None:
    limits = Tightening(max_speed_m_s=2.0, acceleration=1.0, y_max_m=50.0).applied(
        CONFIGURED, PROFILE
    )
    assert limits.max_speed_m_s == 0.4
    assert limits.acceleration_fraction == 0.8
    assert limits.workspace_upper_m == [1.0, 1.0, 1.0]


def test_limits_that_leave_nothing_are_refused() -> None:
    with pytest.raises(InvalidInputError, match="leave nothing"):
        Tightening(y_max_m=-2.0).applied(CONFIGURED, PROFILE)
    flat = Tightening.model_validate({"keep_out": [{"lower_m": [0, 0, 0], "upper_m": [0, 1, 1]}]})
    with pytest.raises(InvalidInputError, match="no box"):
        flat.applied(CONFIGURED, PROFILE)


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"max_speed_m_s": 0.5}, "max_speed_m_s"),
        ({"acceleration_fraction": 1.0}, "acceleration_fraction"),
        ({"zones": ()}, "zones"),
        ({"on_zone": "scale"}, "on_zone"),
        ({"collision": False}, "collision"),
        ({"workspace_upper_m": [1.0, 1.0, 2.0]}, "workspace_upper_m"),
        ({"workspace_lower_m": None}, "workspace_lower_m"),
    ],
)
def test_wider_limits_are_named(change: dict[str, object], key: str) -> None:
    configured = CONFIGURED.model_copy(
        update={"workspace_lower_m": [-1.0, -1.0, 0.0], "workspace_upper_m": [1.0, 1.0, 1.0]}
    )
    check_tighter(configured, configured)
    with pytest.raises(ConfigurationError, match=key):
        check_tighter(configured.model_copy(update=change), configured)


def test_the_file_keeps_who_and_when_and_says_when_it_is_damaged(tmp_path: Path) -> None:
    file = TighteningFile(tmp_path / "state" / "limits.json")
    assert file.read() is None
    record = TightenedRecord(tightening=Tightening(max_speed_m_s=0.1), who="agent", at_ns=7)
    file.write(record)
    assert file.read() == record
    assert [path.name for path in file.path.parent.iterdir()] == ["limits.json"]
    for text in ("{", json.dumps({"tightened": {"max_speed_m_s": "fast"}, "who": "x", "at_ns": 1})):
        file.path.write_text(text)
        with pytest.raises(ConfigurationError, match="cannot be read") as caught:
            file.read()
        assert "roboneuron robot limits --loosen" in caught.value.hint


def test_a_file_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "state").write_text("a file where the folder should be")
    file = TighteningFile(tmp_path / "state" / "limits.json")
    with pytest.raises(RefusedError, match="cannot be kept"):
        file.write(TightenedRecord(tightening=Tightening(), who="agent", at_ns=7))
