"""All conversions between the robot and the network of joint policies, compared with openpi's own
transforms; data/README.md describes the origin of the numbers.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rn_backend_pi0.joint_layout import JointLayout
from rn_backend_pi0.profiles import JOINT_PROFILES
from rn_backend_pi0.prompt import state_bins
from rn_vla.normalisation import Quantiles, Scaling, ZScore
from roboneuron import ConfigurationError

DATA = Path(__file__).parent / "data" / "action-spaces.npz"
EPS = 1e-6
ROUNDING = 1e-12
"""Sums of a few float64 values of order 1 to 10 in another order; any mistake is 1e-3 and more."""
ALOHA = {
    "adapt_delta": "aloha",
    "adapt_absolute": "aloha-absolute",
    "plain_delta": "aloha-plain",
    "plain_absolute": "aloha-plain-absolute",
}
Arrays = dict[str, np.ndarray]


@pytest.fixture(scope="module")
def arrays() -> Arrays:
    """All arrays of the file."""
    with np.load(DATA) as file:
        return dict(file)


def _scaling(arrays: Arrays, variant: str, prefix: str) -> Scaling:
    if variant == "pi0":
        mean, std = arrays[f"{prefix}_mean"], arrays[f"{prefix}_std"]
        return ZScore.of(mean.tolist(), std.tolist(), forward_eps=EPS, backward_eps=EPS)
    low, high = arrays[f"{prefix}_q01"], arrays[f"{prefix}_q99"]
    return Quantiles.of(low.tolist(), high.tolist(), eps=EPS)


def _check(
    layout: JointLayout, arrays: Arrays, variant: str, prefix: str, states: np.ndarray
) -> None:
    state_scaling = _scaling(arrays, variant, f"{prefix}_state")
    action_scaling = _scaling(arrays, variant, f"{prefix}_actions")
    expected_states = arrays[f"{prefix}_model_state"][:, : layout.width]
    answers, expected = arrays[f"{prefix}_model_actions"], arrays[f"{prefix}_actions_out"]
    for raw, model_state in zip(states, expected_states, strict=True):
        normalized = state_scaling.normalize(layout.to_network(raw))
        np.testing.assert_allclose(normalized, model_state, atol=ROUNDING, rtol=ROUNDING)
    for raw, answer, told in zip(states, answers, expected, strict=False):
        actions = action_scaling.denormalize(answer)
        out = layout.to_robot(actions, layout.to_network(raw))
        np.testing.assert_allclose(out, told, atol=ROUNDING, rtol=ROUNDING)


@pytest.mark.parametrize("variant", ["pi0", "pi05"])
@pytest.mark.parametrize("case", ALOHA)
def test_aloha_states_and_actions_are_those_of_openpi(
    arrays: Arrays, variant: str, case: str
) -> None:
    prefix = f"aloha_{variant}_{case}"
    layout = JOINT_PROFILES[ALOHA[case]]
    _check(layout, arrays, variant, prefix, arrays[f"{prefix}_raw_state"])


@pytest.mark.parametrize("variant", ["pi0", "pi05"])
def test_droid_states_and_actions_are_those_of_openpi(arrays: Arrays, variant: str) -> None:
    prefix = f"droid_{variant}"
    states = np.hstack([arrays[f"{prefix}_joint_position"], arrays[f"{prefix}_gripper_position"]])
    _check(JOINT_PROFILES["droid"], arrays, variant, prefix, states)


@pytest.mark.parametrize("variant", ["pi0", "pi05"])
def test_bins_of_the_state_are_those_of_openpi_and_are_not_clipped(
    arrays: Arrays, variant: str
) -> None:
    expected = arrays[f"droid_{variant}_state_bins"]
    states = arrays[f"droid_{variant}_model_state"][:, :8]
    assert [state_bins(state) for state in states] == expected.tolist()
    assert state_bins(np.array([-1.5, -1.0, 0.0, 1.0, 7.0])) == [-1, 0, 128, 255, 255]


def test_droid_rows_are_radians_per_second_and_an_opening() -> None:
    layout = JOINT_PROFILES["droid"]
    rows = layout.to_contract(np.array([[0.5, -0.1, 0, 0, 0, 2.0, -3.0, 0.25]]))
    # 0.2 rad in a period of 1/15 s is 3 rad/s; openpi's example clips to -1..1 first.
    np.testing.assert_allclose(rows[0], [1.5, -0.3, 0, 0, 0, 3.0, -3.0, 0.75], atol=1e-12)
    assert layout.to_contract(np.array([[0.0] * 7 + [1.2]]))[0, 7] == 0.0


def test_joints_are_relative_to_the_state_and_the_gripper_is_not() -> None:
    state = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.9])
    out = JOINT_PROFILES["ur5e"].to_robot(np.full((2, 7), 0.01), state)
    np.testing.assert_allclose(out[1], [0.11, 0.21, 0.31, 0.41, 0.51, 0.61, 0.01], atol=1e-12)


@pytest.mark.parametrize(
    ("name", "kind", "rate_hz", "size"),
    [
        ("droid", "joint_velocity", 15.0, 8),
        ("droid-position", "joint_position", 15.0, 8),
        ("franka", "joint_position", 20.0, 8),
        ("ur5e", "joint_position", 20.0, 7),
        ("aloha", "joint_position", 50.0, 14),
    ],
)
def test_spaces_have_the_kind_rate_and_size_of_the_policy(
    name: str, kind: str, rate_hz: float, size: int
) -> None:
    layout = JOINT_PROFILES[name]
    names = [f"joint{i}" for i in range(size - len(layout.arms))]
    space = layout.space(names)
    assert (space.kind, space.rate_hz, space.size) == (kind, rate_hz, size)
    units = {channel.unit for channel in space.channels}
    assert units == {"opening", "rad/s" if kind == "joint_velocity" else "rad"}


def test_the_channels_of_aloha_belong_to_a_left_and_a_right_arm() -> None:
    names = ["waist", "shoulder", "elbow", "roll", "pitch", "yaw"]
    left_and_right = [*names, *(f"{name}2" for name in names)]
    keys = JOINT_PROFILES["aloha"].space(left_and_right).keys
    assert (keys[0], keys[6], keys[7], keys[13]) == (
        "left/waist",
        "left/gripper_open",
        "right/waist2",
        "right/gripper_open",
    )


@pytest.mark.parametrize("names", [["a"] * 7, ["a", "b"], []])
def test_joints_that_do_not_fit_are_refused(names: list[str]) -> None:
    with pytest.raises(ConfigurationError, match="the policy moves 7, each of"):
        JOINT_PROFILES["droid"].space(names)
