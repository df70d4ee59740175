"""A robot requests the control space and the needs of a model from the server on another
machine.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from policy_servers import RunningServer, robot_of

from rn_backend_openpi.backend import PolicyBackend
from rn_backend_openpi.case import install
from rn_backend_openpi.introduction import from_profile, to_profile
from rn_backend_openpi.messages import from_answer, to_answer
from rn_backend_openpi.space import policy_space
from rn_backend_openpi.wire import pack, unpack
from rn_testing.fakes.site import PluginSite
from roboneuron import (
    EE_DELTA,
    ActionChunk,
    ArmProfile,
    CameraProfile,
    ConfigurationError,
    ControlSpace,
    ForeignDataError,
    GripperProfile,
    RobotProfile,
    robot_space,
)

pytestmark = pytest.mark.timeout(200)
GRIP = GripperProfile(joint="finger", closed_position=0.0, open_position=0.08)
SLIDES = '<robot name="r"><joint name="rail" type="prismatic"/></robot>'
JOINTS = ("rail", "turn")
TWELVE = tuple(f"{arm}{i}" for arm in "lr" for i in range(1, 7))
ARM = RobotProfile(
    name="gantry",
    urdf=SLIDES,
    base_link="base",
    tcp_link="tcp",
    arm_joints=JOINTS,
    gripper=GRIP,
    cameras=(CameraProfile(name="top", role="primary", frame_id="x", width=640, height=480),),
)
PAIR = RobotProfile(
    name="pair",
    base_link="table",
    tcp_link="left_tcp",
    arm_joints=TWELVE,
    arms=tuple(
        ArmProfile(name=name, joints=joints, base_link="b", tcp_link=f"{name}_tcp", gripper=GRIP)
        for name, joints in (("left", TWELVE[:6]), ("right", TWELVE[6:]))
    ),
)
SOURCE = """
from roboneuron import ActionChunk, ActionSpace, BackendSpec, ConfigurationError, hookimpl, robot_space
from rn_backend_openpi.case import Reflex


def declare(options, profile):
    if profile.name == "pair":
        raise ConfigurationError("I move one arm.", hint="Cut one off.")
    return robot_space("joint_position", profile, 20.0)


class Jointed(Reflex):
    pass


@hookimpl
def roboneuron_backends():
    return [BackendSpec(name="jointed", summary="Joints.", target=__name__ + ":Jointed", config="rn_backend_openpi.case:ReflexOptions",
                        space=__name__ + ":declare", cameras=("primary", "wrist"), needs_state=True,
                        action_space=ActionSpace(horizon=12, step_s=0.05), conditions_on_rows=True, max_committed_rows=4)]
"""  # noqa: E501


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[Callable[..., PolicyBackend]]:
    """Return a function that creates a loaded backend for a server with two models."""
    install(tmp_path)
    PluginSite(path=tmp_path / "site").install("rn-jointed", SOURCE, header="")
    listen = {"keys": "token", "token_file": str(tmp_path / "token")}
    server = RunningServer(tmp_path, {"moves": {}, "joints": {"backend": "jointed"}}, listen)
    with ExitStack() as stack:
        stack.callback(server.end)
        server.start()

        def make(model: str) -> PolicyBackend:
            made = robot_of(server.address, token_file=str(tmp_path / "token"), model=model)
            stack.callback(made.close)
            made.load()
            return made

        yield make


def test_the_server_tells_space_cameras_and_rows(robot: Callable[..., PolicyBackend]) -> None:
    joints = robot("joints")
    told = joints.served_spec(ARM)
    assert told is not None
    served, space = told
    assert space == robot_space("joint_position", ARM, 20.0)
    assert [channel.unit for channel in space.channels] == ["m", "rad", "opening"]
    assert served.cameras == ("primary", "wrist")
    assert (served.action_space.horizon, served.action_space.step_s) == (12, 0.05)
    assert (served.conditions_on_rows, served.max_committed_rows) == (True, 4)
    with pytest.raises(ConfigurationError, match=r"I move one arm\. Cut one off"):
        joints.served_spec(PAIR)
    told = robot("moves").served_spec(ARM)
    assert told is not None
    assert told[1] is EE_DELTA
    assert told[0].max_committed_rows == 0


@pytest.mark.parametrize("profile", [ARM, PAIR, RobotProfile(name="base")])
def test_what_a_space_depends_on_arrives(profile: RobotProfile) -> None:
    there = to_profile(json.loads(json.dumps(from_profile(profile))))
    assert there.name == profile.name
    assert [(c.name, c.role) for c in there.cameras] == [(c.name, c.role) for c in profile.cameras]
    assert there.arms == profile.arms
    kinds = ("joint_position", "joint_velocity", "ee_pose") if profile.arm_joints else ()
    for kind in kinds:
        assert robot_space(kind, there, 5.0) == robot_space(kind, profile, 5.0)


@pytest.mark.parametrize(
    "changed",
    [
        {"name": 7},
        {"arm_joints": "rail"},
        {"arm_joints": ["j"] * 300},
        {"arms": [["left"]]},
        {"gripper": [1, 2, 3]},
        {"cameras": [["top", "primary", 0, 480]]},
        {"slides": None},
    ],
)
def test_what_is_no_robot_is_refused(changed: dict[str, Any]) -> None:
    with pytest.raises(ForeignDataError):
        to_profile({**from_profile(ARM), **changed})


def sent(chunk: ActionChunk) -> ActionChunk:
    """The chunk after encoding and decoding."""
    found = unpack(pack(from_answer(chunk)))
    assert isinstance(found, dict)
    return to_answer(found)


def test_the_space_travels_with_the_chunk_and_deltas_stay_the_contracts_own() -> None:
    space = robot_space("joint_position", ARM, 30.0)
    rows = np.full((2, space.size), 0.5)
    assert sent(ActionChunk(actions=rows, step_s=1 / 30, space=space)).space == space
    assert sent(ActionChunk(actions=np.zeros((1, 7)), step_s=0.1)).space is EE_DELTA


def test_the_backend_that_holds_the_model_says_its_space() -> None:
    own = {"profile": "own", "constants": "aloha", "joints": list(TWELVE)}
    space = policy_space({"backend": "oft", "options": own}, PAIR)
    assert space is not None
    assert (space.kind, space.size) == ("joint_position", 14)
    with pytest.raises(ConfigurationError, match="needs the option 'joints'"):
        policy_space({"backend": "oft", "options": {**own, "joints": None}}, PAIR)
    for options in ({"backend": "elsewhere"}, {"backend": "oft"}, {"no": 1}):
        assert policy_space(options, PAIR) is EE_DELTA


def test_the_space_of_a_model_with_an_address_is_said_by_a_person() -> None:
    def space_of(**given: Any) -> ControlSpace | None:
        return policy_space({"address": "gpu:1", **given}, PAIR)

    assert space_of() is None, "before the server is reached"
    space = space_of(space={"kind": "joint_position", "rate_hz": 20.0})
    assert space == robot_space("joint_position", PAIR, 20.0)
    assert space_of(space={"kind": "ee_delta"}) is EE_DELTA
    turned = space.keys[::-1]
    for kind in ("joint_position", "joint_delta"):
        own = space_of(space={"kind": kind, "channels": list(turned)})
        assert own is not None
        assert (own.kind, own.keys, own.channels[-1]) == (kind, turned, space.channels[0])
    for wrong in (
        {"kind": "joint_position", "channels": ["l1", "elbow"]},
        {"kind": "joint_position", "channels": ["left/l1", "left/l1"]},
        {"kind": "sideways"},
        {"kind": "ee_delta", "channels": ["x"]},
    ):
        with pytest.raises(ConfigurationError, match="The option space"):
            space_of(space=wrong)
