"""Chunks of a shared model in another space than TCP deltas."""

from __future__ import annotations

import numpy as np
import pytest

from rn_backend_openpi.batching import _with_metrics
from rn_backend_openpi.messages import from_answer, to_answer
from rn_backend_openpi.space import policy_space
from rn_backend_openpi.wire import pack, unpack
from roboneuron import (
    EE_DELTA,
    GRIPPER,
    ActionChunk,
    ArmProfile,
    Channel,
    ConfigurationError,
    ControlSpace,
    GripperProfile,
    RobotProfile,
)

JOINTS = [f"{arm}{i}" for arm in ("left", "right") for i in range(6)]
ROBOT = RobotProfile(
    name="pair",
    base_link="table",
    tcp_link="left_tcp",
    arm_joints=tuple(JOINTS),
    arms=tuple(
        ArmProfile(
            name=arm,
            joints=tuple(name for name in JOINTS if name.startswith(arm)),
            base_link=f"{arm}_base",
            tcp_link=f"{arm}_tcp",
            gripper=GripperProfile(joint=f"{arm}_finger", closed_position=0.0, open_position=0.08),
        )
        for arm in ("left", "right")
    ),
)


def sent(chunk: ActionChunk) -> ActionChunk:
    """The chunk after encoding and decoding."""
    found = unpack(pack(from_answer(chunk)))
    assert isinstance(found, dict)
    return to_answer(found)


def test_the_space_travels_with_the_chunk() -> None:
    channels = (
        Channel(name="joint1", unit="rad", arm="left"),
        Channel(name="x", unit="m", frame="base"),
        Channel(name=GRIPPER, unit="opening"),
    )
    space = ControlSpace(kind="joint_position", channels=channels, rate_hz=30.0)
    chunk = ActionChunk(actions=np.full((2, 3), 0.5), step_s=1 / 30, space=space)
    counted = _with_metrics(chunk, 1, 0.1)
    assert isinstance(counted, ActionChunk)
    assert sent(counted).space == space


def test_deltas_of_the_tcp_stay_the_contracts_own() -> None:
    assert sent(ActionChunk(actions=np.zeros((1, 7)), step_s=0.1)).space is EE_DELTA


def test_the_backend_that_holds_the_model_says_its_space() -> None:
    own = {"profile": "own", "constants": "aloha", "joints": JOINTS}
    space = policy_space({"backend": "oft", "options": own}, ROBOT)
    assert space.kind == "joint_position"
    assert space.size == 14
    with pytest.raises(ConfigurationError, match="needs the option 'joints'"):
        policy_space({"backend": "oft", "options": {**own, "joints": None}}, ROBOT)


def test_the_space_of_a_model_with_an_address_is_said_by_a_person() -> None:
    given = {"address": "gpu:1", "space": {"kind": "joint_position", "rate_hz": 20.0}}
    space = policy_space(given, ROBOT)
    assert (space.kind, space.rate_hz, space.size) == ("joint_position", 20.0, 14)
    assert policy_space({**given, "space": {"kind": "ee_delta"}}, ROBOT) is EE_DELTA
    turned = tuple(reversed(space.keys))
    for kind in ("joint_position", "joint_delta"):
        own = policy_space({**given, "space": {"kind": kind, "channels": list(turned)}}, ROBOT)
        assert own.kind == kind
        assert own.keys == turned
        assert own.channels[-1] == space.channels[0]
    for wrong in (
        {"kind": "joint_position", "channels": ["left0", "elbow"]},
        {"kind": "joint_position", "channels": ["left/left0", "left/left0"]},
        {"kind": "sideways"},
        {"kind": "ee_delta", "channels": ["x"]},
    ):
        with pytest.raises(ConfigurationError, match="The option space"):
            policy_space({**given, "space": wrong}, ROBOT)


@pytest.mark.parametrize("options", [{"backend": "elsewhere"}, {"backend": "oft"}, {"no": 1}])
def test_other_models_move_the_tcp(options: dict[str, object]) -> None:
    assert policy_space(options, ROBOT) is EE_DELTA
