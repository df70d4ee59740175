"""What a client asks for is merged into something tighter, and never into something wider than
configured.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rn_standard.tools_arm.tightening import TightenedRecord, Tightening, TighteningFile
from roboneuron.config import LimitsConfig
from roboneuron.contract import RobotProfile, Workspace
from roboneuron.errors import ConfigurationError, InvalidInputError, RefusedError
from roboneuron.gate.motion import check_tighter

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
        assert "roboneuron limits --loosen" in caught.value.hint


def test_a_file_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "state").write_text("a file where the folder should be")
    file = TighteningFile(tmp_path / "state" / "limits.json")
    with pytest.raises(RefusedError, match="cannot be kept"):
        file.write(TightenedRecord(tightening=Tightening(), who="agent", at_ns=7))
