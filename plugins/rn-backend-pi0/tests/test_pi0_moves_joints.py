"""The native backend with joint policies: names, units, control space, real-time chunking."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rn_backend_pi0.chunking import RunningChunk
from rn_backend_pi0.native import Pi0Backend
from rn_backend_pi0.options import Pi0Options
from rn_backend_pi0.plugin import roboneuron_backends
from rn_backend_pi0.profiles import JOINT_PROFILES
from rn_backend_pi0.space import pi0_space
from rn_backend_pi0.tiny import make_tiny
from roboneuron import (
    EE_DELTA,
    Ahead,
    ArmProfile,
    ArmState,
    CheckpointError,
    ConfigurationError,
    GripperProfile,
    JointSample,
    Observation,
    PlanningError,
    Pose,
    RobotProfile,
    UngroundedError,
)
from roboneuron.contract import SPACE_KINDS
from roboneuron.modules.inference.agreement import agree

Observe = Callable[..., Observation]


def pair_of(count: int) -> RobotProfile:
    """A robot with two arms of `count` joints."""
    arms = tuple(
        ArmProfile(
            name=arm,
            joints=tuple(f"{arm}_{i + 1}" for i in range(count)),
            base_link="base",
            tcp_link=f"{arm}_tcp",
            gripper=GripperProfile(joint=f"{arm}_finger", closed_position=0.0, open_position=0.04),
        )
        for arm in ("left", "right")
    )
    joints = tuple(joint for arm in arms for joint in arm.joints)
    return RobotProfile(name="pair", arm_joints=joints, arms=arms)


ARM = tuple(f"arm_joint{i}" for i in range(1, 8))
ROBOT = RobotProfile(
    name="seven",
    arm_joints=ARM,
    gripper=GripperProfile(joint="finger", closed_position=0.0, open_position=0.04),
)
TWO_ARMED = pair_of(6)
BOTH = TWO_ARMED.arm_joints
BOTH_RAD = np.concatenate([0.1 * np.arange(1, 7), -0.1 * np.arange(1, 7)])
POSTURE = np.array([0.1, -0.7, 0.2, -2.2, 0.3, 1.5, 0.9])


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Tiny checkpoints by name."""
    root = tmp_path_factory.mktemp("joints")
    make_tiny(root / "droid", variant="pi05", profile="droid")
    make_tiny(root / "franka", layout="openpi", profile="franka")
    make_tiny(root / "aloha", layout="openpi", profile="aloha")
    return {path.name: path for path in root.iterdir()}


def _backend(checkpoint: Path, **options: Any) -> Pi0Backend:
    given = {"joints": ARM, "noise": "fixed", **options}
    return Pi0Backend(Pi0Options(checkpoint=checkpoint, device="cpu", cpu_threads=1, **given))


@pytest.fixture(scope="module", params=["droid", "franka"])
def backend(request: pytest.FixtureRequest, checkpoints: dict[str, Path]) -> Iterator[Pi0Backend]:
    """A loaded backend of each kind."""
    backend = _backend(checkpoints[request.param])
    backend.load()
    yield backend
    backend.close()


def _seen(observe: Observe, names: tuple[str, ...] = ARM, **changes: Any) -> Observation:
    """An observation in which joint `arm_joint<i>` is at POSTURE[i - 1], in any order."""
    position = np.array([POSTURE[int(name[-1]) - 1] for name in names])
    joints = JointSample(names=names, position=position)
    return replace(observe(**changes), joints=joints, ee_pose=None)


def test_a_chunk_has_the_space_that_the_descriptor_declares(
    backend: Pi0Backend, observe: Observe
) -> None:
    checkpoint = backend._config.checkpoint
    space = pi0_space({"checkpoint": str(checkpoint), "joints": list(ARM)}, ROBOT)
    chunk = backend.predict(_seen(observe))
    assert chunk.space == space
    assert space.keys == (*ARM, "gripper_open")
    assert chunk.step_s == pytest.approx(1.0 / space.rate_hz)
    assert chunk.actions.shape == (10, 8)


def test_the_descriptor_names_the_function() -> None:
    spec = next(spec for spec in roboneuron_backends() if spec.name == "pi0")
    assert spec.space == f"{pi0_space.__module__}:{pi0_space.__name__}"


def test_joints_are_taken_by_name_from_any_order(backend: Pi0Backend, observe: Observe) -> None:
    straight = backend.predict(_seen(observe)).actions
    shuffled = backend.predict(_seen(observe, names=ARM[::-1])).actions
    np.testing.assert_array_equal(straight, shuffled)


def test_the_policys_joints_are_those_that_the_option_names(
    checkpoints: dict[str, Path], observe: Observe
) -> None:
    other = _backend(checkpoints["franka"], joints=ARM[::-1])
    other.load()
    chunk = other.predict(_seen(observe))
    assert chunk.space.keys == (*ARM[::-1], "gripper_open")
    # Targets are near the measured joints of the same name, because deltas of a tiny model are
    # small.
    np.testing.assert_allclose(chunk.actions[:, :7], np.tile(POSTURE[::-1], (10, 1)), atol=0.15)


def test_positions_are_the_measured_joints_plus_what_the_network_says(
    checkpoints: dict[str, Path], observe: Observe
) -> None:
    backend = _backend(checkpoints["franka"])
    backend.load()
    chunk = backend.predict(_seen(observe))
    assert isinstance(chunk.context, RunningChunk)
    stats = json.loads((checkpoints["franka"] / "assets/tiny/norm_stats.json").read_text())
    actions = stats["norm_stats"]["actions"]
    raw = chunk.context.normalized[:, :8].astype(np.float64)
    raw = raw * (np.array(actions["std"]) + 1e-6) + np.array(actions["mean"])
    # float64 on both sides; only the order of the operations may differ.
    np.testing.assert_allclose(chunk.actions[:, :7], raw[:, :7] + POSTURE, atol=1e-12)
    np.testing.assert_allclose(chunk.actions[:, 7], np.clip(1 - raw[:, 7], 0, 1), atol=1e-12)


def test_state_and_gripper_change_the_actions(backend: Pi0Backend, observe: Observe) -> None:
    before = backend.predict(_seen(observe, gripper_open=1.0)).actions
    assert np.abs(backend.predict(_seen(observe, gripper_open=0.0)).actions - before).max() > 1e-5


def test_a_joint_that_is_not_measured_is_an_error(backend: Pi0Backend, observe: Observe) -> None:
    with pytest.raises(UngroundedError, match="arm_joint7"):
        backend.predict(_seen(observe, names=ARM[:6]))
    with pytest.raises(UngroundedError, match="gripper"):
        backend.predict(_seen(observe, gripper_open=None))


def test_relative_rows_follow_the_measured_joints(backend: Pi0Backend) -> None:
    """The remaining rows of a chunk have the same targets after the arm has moved."""
    assert backend._model is not None
    assert backend._conversion is not None
    old, new = np.zeros(8), np.full(8, 0.25)
    running = RunningChunk(normalized=np.zeros(backend._model.noise_shape, np.float32), state=old)
    ahead = Ahead(rows=np.zeros((4, 8)), committed_rows=2, step_s=0.05, context=running)
    prefix = backend.prefix_of(ahead, new)
    assert prefix is not None
    at = backend._conversion.relative
    action = backend._model.action.head(8)
    before = action.denormalize(running.normalized[:, :8])
    after = action.denormalize(prefix.rows[:, :8])
    before[:, at] += old[at]
    after[:, at] += new[at]
    np.testing.assert_allclose(after, before, atol=1e-6)  # rows are float32
    assert len(at) == (7 if backend._conversion.space.kind == "joint_position" else 0)


def test_a_running_chunk_is_continued(backend: Pi0Backend, observe: Observe) -> None:
    first = backend.predict(_seen(observe))
    ahead = Ahead(rows=first.actions, committed_rows=3, step_s=first.step_s, context=first.context)
    free = backend.predict(_seen(observe, primary=200))
    bound = backend.predict(replace(_seen(observe, primary=200), ahead=ahead))
    assert bound.conditioned_rows == 3
    near = np.abs(bound.actions[:3] - first.actions[:3]).max()
    assert near <= np.abs(free.actions[:3] - first.actions[:3]).max()


@pytest.mark.parametrize(
    ("joints", "message"),
    [
        (None, "needs the option 'joints'"),
        (["arm_joint1"], "the policy moves 7"),
        ([*ARM[:6], "elbow"], "elbow, which robot 'seven'"),
    ],
)
def test_planning_learns_that_joints_do_not_fit(
    checkpoints: dict[str, Path], joints: list[str] | None, message: str
) -> None:
    options = {"checkpoint": checkpoints["droid"], "joints": joints}
    with pytest.raises(ConfigurationError, match=message) as refusal:
        pi0_space(options, ROBOT)
    if joints is None:
        assert 'joints = ["arm_joint1", "arm_joint2"' in refusal.value.hint


def test_loading_without_joints_is_refused(checkpoints: dict[str, Path]) -> None:
    with pytest.raises(ConfigurationError, match="needs the option 'joints'"):
        _backend(checkpoints["droid"], joints=None).load()


def test_joints_of_a_policy_that_moves_the_tcp_are_refused(tiny_checkpoint: Path) -> None:
    with pytest.raises(ConfigurationError, match="'joints' has no effect"):
        _backend(tiny_checkpoint).load()
    assert pi0_space({"checkpoint": str(tiny_checkpoint)}, ROBOT) is EE_DELTA


def test_the_option_goes_before_what_the_checkpoint_says(checkpoints: dict[str, Path]) -> None:
    options = {"checkpoint": checkpoints["droid"], "profile": "franka", "joints": ARM}
    assert pi0_space(options, ROBOT).kind == "joint_position"


def _both_seen(observe: Observe, **changes: Any) -> Observation:
    """An observation of a robot with two arms, left 0.1 i and right -0.1 i, in a shuffled order."""
    names = BOTH[::-1]
    position = np.array([BOTH_RAD[BOTH.index(name)] for name in names])
    pose = Pose(position_m=np.zeros(3), quaternion_xyzw=np.array([0.0, 0.0, 0.0, 1.0]))
    arms = {
        "right": ArmState(ee_pose=pose, gripper_open=0.75),
        "left": ArmState(ee_pose=pose, gripper_open=0.25),
    }
    joints = JointSample(names=names, position=position)
    given = {"joints": joints, "arms": arms, "gripper_open": 0.25, **changes}
    return replace(observe(), ee_pose=None, **given)


@pytest.mark.parametrize("name", ["aloha", "aloha-absolute", "aloha-plain", "aloha-plain-absolute"])
def test_both_arms_of_aloha_move_by_what_openpi_computes(
    tmp_path: Path, observe: Observe, name: str
) -> None:
    make_tiny(tmp_path / "tiny", layout="openpi", profile=name)
    backend = _backend(tmp_path / "tiny", joints=BOTH)
    backend.load()
    chunk = backend.predict(_both_seen(observe))
    assert chunk.space == pi0_space({"profile": name, "joints": BOTH}, TWO_ARMED)
    agree(chunk.space, TWO_ARMED, SPACE_KINDS, backend="pi0", controller="urdf")
    assert isinstance(chunk.context, RunningChunk)
    layout = JOINT_PROFILES[name]
    measured = np.insert(BOTH_RAD, [6, 12], [0.25, 0.75])
    state = layout.to_network(measured)
    np.testing.assert_allclose(chunk.context.state, state, atol=1e-12)
    stats = json.loads((tmp_path / "tiny/assets/tiny/norm_stats.json").read_text())["norm_stats"]
    spread = np.array(stats["actions"]["std"]) + 1e-6
    raw = chunk.context.normalized[:, :14].astype(np.float64) * spread + stats["actions"]["mean"]
    # `to_robot` is compared with openpi's own numbers in test_pi0_joint_spaces_are_those_of_openpi.
    told = layout.to_robot(raw, state)
    told[:, [6, 13]] = told[:, [6, 13]].clip(0.0, 1.0)
    np.testing.assert_allclose(chunk.actions, told, atol=1e-9)


def test_what_is_not_measured_of_either_arm_is_an_error(
    checkpoints: dict[str, Path], observe: Observe
) -> None:
    backend = _backend(checkpoints["aloha"], joints=BOTH)
    backend.load()
    seen = _both_seen(observe)
    left_only = {"left": seen.arms["left"]}
    with pytest.raises(UngroundedError, match="the gripper's opening of arm 'right'"):
        backend.predict(replace(seen, arms=left_only))
    joints = JointSample(names=BOTH[:11], position=BOTH_RAD[:11])
    with pytest.raises(UngroundedError, match="The state needs right_6; the joints that are"):
        backend.predict(replace(seen, joints=joints))


def test_arms_of_six_joints_are_refused_on_arms_of_seven(checkpoints: dict[str, Path]) -> None:
    pair = pair_of(7)
    space = pi0_space({"checkpoint": checkpoints["aloha"], "joints": BOTH}, pair)
    with pytest.raises(PlanningError, match="the backend lacks left/left_7, right/right_7"):
        agree(space, pair, SPACE_KINDS, backend="pi0", controller="urdf")


def test_two_arms_are_refused_on_a_robot_that_has_one(checkpoints: dict[str, Path]) -> None:
    six = RobotProfile(name="six", arm_joints=BOTH[:6])
    with pytest.raises(ConfigurationError, match=r"right_1, right_2.* which robot 'six' does not"):
        pi0_space({"checkpoint": checkpoints["aloha"], "joints": BOTH}, six)


def test_arms_are_not_swapped_by_the_order_of_joints(checkpoints: dict[str, Path]) -> None:
    swapped = (*BOTH[6:], *BOTH[:6])
    space = pi0_space({"checkpoint": checkpoints["aloha"], "joints": swapped}, TWO_ARMED)
    with pytest.raises(PlanningError, match="the robot lacks left/right_1"):
        agree(space, TWO_ARMED, SPACE_KINDS, backend="pi0", controller="urdf")


@pytest.mark.parametrize("block", ["state", "actions"])
@pytest.mark.parametrize(("profile", "joints", "width"), [("franka", ARM, 8), ("aloha", BOTH, 14)])
def test_statistics_that_lack_a_channel_are_refused(
    tmp_path: Path, profile: str, joints: tuple[str, ...], width: int, block: str
) -> None:
    make_tiny(tmp_path / "tiny", layout="openpi", profile=profile)
    file = tmp_path / "tiny/assets/tiny/norm_stats.json"
    stats = json.loads(file.read_text())
    for values in stats["norm_stats"][block].values():
        del values[3]
    file.write_text(json.dumps(stats))
    what = block.removesuffix("s")
    told = f"has statistics of {width - 1} {what} values, the profile has {width}."
    with pytest.raises(CheckpointError, match=re.escape(told)):
        _backend(tmp_path / "tiny", joints=joints).load()


@pytest.mark.parametrize("name", ["droid", "franka"])
def test_a_robot_executes_the_space_in_its_own_order(
    checkpoints: dict[str, Path], observe: Observe, name: str
) -> None:
    """The control spaces that planning and inference use for a chunk."""
    backend = _backend(checkpoints[name], joints=ARM[::-1])
    backend.load()
    options = {"checkpoint": checkpoints[name], "joints": ARM[::-1]}
    space = pi0_space(options, ROBOT)
    agreement = agree(space, ROBOT, SPACE_KINDS, backend="pi0", controller="urdf")
    chunk = backend.predict(_seen(observe))
    executed = agreement.convert(chunk, None)
    assert executed.space.keys == (*ARM, "gripper_open")
    np.testing.assert_array_equal(executed.actions[:, :7], chunk.actions[:, 6::-1])


@pytest.mark.parametrize("name", JOINT_PROFILES)
def test_every_profile_of_joints_may_be_named(name: str) -> None:
    assert Pi0Options(checkpoint=Path("x"), profile=name).profile == name  # type: ignore[arg-type]
