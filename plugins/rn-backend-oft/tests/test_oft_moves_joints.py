"""OFT checkpoints with joint actions: ALOHA's numbers, and a policy of one arm from observation to
chunk.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from pydantic import ValidationError

from rn_backend_oft.backend import OftBackend, OftPairBackend, OftPrimaryBackend
from rn_backend_oft.components import head_shard, proprio_shard
from rn_backend_oft.config import OftConfig
from rn_backend_oft.constants import CONSTANTS
from rn_backend_oft.plugin import roboneuron_backends
from rn_backend_oft.space import oft_space
from rn_backend_oft.tiny import make_tiny_oft
from rn_runtime_torch.config import TorchRuntimeConfig
from rn_runtime_torch.runtime import TorchRuntime
from rn_vla.openvla.checkpoint import OpenvlaCheckpoint
from rn_vla.openvla.statistics import Scaling, VectorStatistics
from rn_vla.openvla.tiny import random_values
from roboneuron import (
    EE_DELTA,
    ArmProfile,
    ArmState,
    ConfigurationError,
    Frame,
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

ARM = tuple(f"joint{i}" for i in range(1, 7))
ROBOT = RobotProfile(name="six", arm_joints=ARM)
OWN = {"chunk": 4, "action_width": 7, "state": "joints", "bounds": "minmax", "step_s": 0.04}
OPTIONS = {"profile": "joints", "constants": "own", "own_constants": OWN, "joints": ARM}


def _pair(joints: tuple[str, ...]) -> RobotProfile:
    arms = tuple(
        ArmProfile(
            name=arm,
            joints=tuple(f"{arm}_{joint}" for joint in joints),
            base_link="base",
            tcp_link=f"{arm}_tcp",
            gripper=GripperProfile(joint=f"{arm}_finger", closed_position=0, open_position=1),
        )
        for arm in ("left", "right")
    )
    names = tuple(joint for arm in arms for joint in arm.joints)
    return RobotProfile(name="pair", arm_joints=names, arms=arms)


TWO_ARMED = _pair(ARM)
BOTH_ARMS = TWO_ARMED.arm_joints
ALOHA = {"constants": "aloha", "profile": "joints", "joints": list(BOTH_ARMS)}


@pytest.fixture(scope="module")
def aloha() -> dict[str, np.ndarray]:
    """Values computed by OFT's own code with ALOHA's constants; see data/README.md."""
    with np.load(Path(__file__).parent / "data" / "aloha.npz") as arrays:
        return dict(arrays)


@pytest.fixture(scope="module")
def tiny(tmp_path_factory) -> Path:
    """A tiny checkpoint whose head and proprio projector are those of six joints and a gripper."""
    path = tmp_path_factory.mktemp("joints") / "oft"
    make_tiny_oft(path)
    limits = {"min": [-2.0] * 6 + [0.0], "max": [2.0] * 6 + [1.0]}
    block = limits | {"q01": limits["min"], "q99": limits["max"]}
    statistics = {"tiny": {"action": block, "proprio": block}}
    (path / "dataset_statistics.json").write_text(json.dumps(statistics))
    decoder = OpenvlaCheckpoint.read(path).decoder
    generator = np.random.default_rng(5)
    for shard in (
        head_shard(path / "action_head--1_checkpoint.pt", decoder, 7),
        proprio_shard(path / "proprio_projector--1_checkpoint.pt", decoder, 7),
    ):
        tensors = {
            name: torch.from_numpy(random_values(name, weight, generator))
            for name, weight in shard.weights.items()
        }
        torch.save(tensors, shard.path)
    return path


def _backend(path: Path, **options) -> OftBackend:
    runtime = TorchRuntime(TorchRuntimeConfig(device="cpu", dtype="float32"))
    config = OftConfig(checkpoint=path, proprio=True, **{**OPTIONS, **options})
    return OftPrimaryBackend(config, runtime=runtime)


@pytest.fixture(scope="module")
def backend(tiny: Path) -> OftBackend:
    """A loaded backend with this checkpoint."""
    made = _backend(tiny)
    made.load()
    return made


def _observation(names: tuple[str, ...] = ARM, opening: float | None = 0.5) -> Observation:
    image = np.full((224, 224, 3), 80, dtype=np.uint8)
    position = np.array([0.1 * int(name[-1]) for name in names])
    return Observation(
        frames={
            "primary": Frame(camera="primary", image=image, stamp_ns=1, frame_id="primary_optical")
        },
        instruction="pick up the cube",
        joints=JointSample(names=names, position=position),
        gripper_open=opening,
    )


def _scaling(aloha: dict[str, np.ndarray]) -> Scaling:
    low, high = tuple(aloha["min"].tolist()), tuple(aloha["max"].tolist())
    statistics = VectorStatistics(min=low, max=high, q01=low, q99=high)
    return Scaling.of(statistics, CONSTANTS["aloha"].bounds, 1e-8)


def test_actions_of_aloha_are_those_of_the_public_code(aloha):
    # float64 on both sides; a mistake (quantiles, clipping, no eps) is 1e-9 and more.
    units = _scaling(aloha).to_units(aloha["normalized"])
    np.testing.assert_allclose(units, aloha["actions"], atol=1e-13, rtol=0)
    assert np.abs(aloha["normalized"]).max() > 1.0


def test_proprio_of_aloha_is_normalised_and_clipped_as_in_the_public_code(aloha):
    normalized = _scaling(aloha).to_normalized(aloha["proprio"])
    np.testing.assert_allclose(normalized, aloha["proprio_normalized"], atol=1e-13, rtol=0)


def test_rows_of_aloha_are_two_arms_with_openings_cut_to_their_range(aloha):
    rows, native = CONSTANTS["aloha"].rows(), aloha["actions"][0]
    space, actions = rows.space(BOTH_ARMS), rows.to_contract(native)
    joints = [i for i, key in enumerate(space.keys) if not key.endswith("gripper_open")]
    np.testing.assert_array_equal(actions[:, joints], native[:, joints])
    np.testing.assert_array_equal(actions[:, [6, 13]], np.clip(native[:, [6, 13]], 0, 1))
    assert space.keys[6] == "left/gripper_open"
    assert space.keys[7] == "right/right_joint1"
    assert (space.kind, space.rate_hz, space.size) == ("joint_position", 25.0, 14)
    for row in actions:
        space.check(row)


@pytest.fixture(scope="module")
def both(tmp_path_factory) -> OftBackend:
    """`oft-pair` with a tiny checkpoint of ALOHA, loaded."""
    path = tmp_path_factory.mktemp("both") / "oft"
    make_tiny_oft(path, platform="aloha")
    runtime = TorchRuntime(TorchRuntimeConfig(device="cpu", dtype="float32"))
    made = OftPairBackend(OftConfig(checkpoint=path, proprio=True, **ALOHA), runtime=runtime)
    made.load()
    return made


def _both_seen(**changes) -> Observation:
    """Left joints at 0.01, 0.02 .., right ones at -0.01, -0.02 .., in the robot's order."""
    position = np.array([0.01 * int(n[-1]) * (1 if n[0] == "l" else -1) for n in BOTH_ARMS])
    pose = Pose(position_m=np.zeros(3), quaternion_xyzw=np.array([0.0, 0.0, 0.0, 1.0]))
    grey = np.full((224, 224, 3), 80, dtype=np.uint8)
    given = {
        "frames": {
            role: Frame(camera=role, image=grey, stamp_ns=1, frame_id=role)
            for role in ("primary", "wrist", "right_wrist")
        },
        "instruction": "fold the shirt",
        "joints": JointSample(names=BOTH_ARMS[::-1], position=position[::-1]),
        "gripper_open": 0.25,
        "arms": {
            "right": ArmState(ee_pose=pose, gripper_open=0.75),
            "left": ArmState(ee_pose=pose, gripper_open=0.25),
        },
    }
    return Observation(**{**given, **changes})


def test_both_arms_of_aloha_move(both, monkeypatch):
    requests = []
    runtime = both._runtime
    run = runtime.run
    monkeypatch.setattr(runtime, "run", lambda request: requests.append(request) or run(request))
    chunk = both.predict(_both_seen())
    assert chunk.space == oft_space(ALOHA, TWO_ARMED)
    assert (chunk.actions.shape, chunk.step_s) == ((25, 14), 0.04)
    agree(chunk.space, TWO_ARMED, SPACE_KINDS, backend="oft-pair", controller="urdf")
    # Joints within 0.5 rad and openings 0..1 are -1..1 in the tiny checkpoint's statistics.
    arm = 0.02 * np.arange(1, 7)
    expected = [*arm, -0.5, *-arm, 0.5]
    np.testing.assert_allclose(requests[0].prompt.arrays["proprio"], expected, atol=1e-6)


@pytest.mark.parametrize(
    ("block", "words"),
    [
        ("action", "has 13 action values, constants = 'aloha' says 14"),
        ("proprio", "13 proprio val"),
    ],
)
def test_statistics_that_lack_a_channel_are_refused(tmp_path, block, words):
    make_tiny_oft(tmp_path / "oft", platform="aloha")
    file = tmp_path / "oft" / "dataset_statistics.json"
    statistics = json.loads(file.read_text())
    for values in statistics["tiny"][block].values():
        del values[3]
    file.write_text(json.dumps(statistics))
    runtime = TorchRuntime(TorchRuntimeConfig(device="cpu", dtype="float32"))
    config = OftConfig(checkpoint=tmp_path / "oft", proprio=True, **ALOHA)
    with pytest.raises(ConfigurationError, match=words):
        OftPairBackend(config, runtime=runtime).load()


def test_a_gripper_that_is_not_measured_is_named_with_its_arm(both):
    seen = _both_seen()
    with pytest.raises(UngroundedError, match="the gripper's opening of arm 'right'"):
        both.predict(dataclasses.replace(seen, arms={"left": seen.arms["left"]}))


def test_arms_of_another_length_or_number_are_refused_by_planning():
    with pytest.raises(ConfigurationError, match=r"left_joint1.* which robot 'six' does not have"):
        oft_space(ALOHA, ROBOT)
    longer = _pair((*ARM, "joint7"))
    with pytest.raises(PlanningError, match="backend lacks left/left_joint7, right/right_joint7"):
        agree(oft_space(ALOHA, longer), longer, SPACE_KINDS, backend="oft", controller="urdf")


def test_an_action_width_that_is_no_two_equal_arms_is_refused():
    odd = dataclasses.replace(CONSTANTS["aloha"], action_width=13)
    with pytest.raises(ConfigurationError, match="action_width 13 does not hold joints"):
        odd.rows()


def test_a_chunk_of_one_arm_has_the_declared_space(backend):
    chunk = backend.predict(_observation())
    assert chunk.space == oft_space(OPTIONS, ROBOT)
    assert chunk.space.keys == (*ARM, "gripper_open")
    assert chunk.actions.shape == (4, 7)
    assert chunk.step_s == 0.04
    assert all(spec.space == "rn_backend_oft.space:oft_space" for spec in roboneuron_backends())


def test_joints_are_taken_by_name(backend):
    straight = backend.predict(_observation()).actions
    shuffled = backend.predict(_observation(names=("elsewhere0", *ARM[::-1]))).actions
    np.testing.assert_array_equal(straight, shuffled)


def test_a_gripper_counted_the_other_way_is_turned_both_ways(tiny, backend):
    turned = _backend(tiny, own_constants={**OWN, "gripper": "closed_fraction"})
    turned.load()
    plain = backend.predict(_observation(opening=0.2)).actions
    other = turned.predict(_observation(opening=0.8)).actions
    np.testing.assert_allclose(other[:, :6], plain[:, :6], atol=1e-6)
    np.testing.assert_allclose(other[:, 6], 1.0 - plain[:, 6], atol=1e-6)


@pytest.mark.parametrize("change", [{"names": ARM[:5]}, {"opening": None}])
def test_what_is_not_measured_is_an_error(backend, change):
    with pytest.raises(UngroundedError, match=r"joint6|gripper"):
        backend.predict(_observation(**change))
    with pytest.raises(UngroundedError):
        backend.predict(dataclasses.replace(_observation(), joints=None))


@pytest.mark.parametrize(
    ("joints", "message"),
    [
        (None, "needs the option 'joints'"),
        (["joint1"], "the policy moves 6"),
        ([*ARM[:5], "elbow"], "elbow, which robot"),
    ],
)
def test_planning_learns_that_joints_do_not_fit(joints, message):
    with pytest.raises(ConfigurationError, match=message) as refusal:
        oft_space({**OPTIONS, "joints": joints}, ROBOT)
    if joints is None:
        assert 'joints = ["joint1", "joint2"' in refusal.value.hint


@pytest.mark.parametrize(
    "change", [{"profile": "libero"}, {"joints": None}, {"constants": "libero"}]
)
def test_options_that_contradict_each_other_are_refused(tiny, change):
    own = {} if "constants" not in change else {"own_constants": None}
    with pytest.raises(ConfigurationError, match=r"profile"):
        _backend(tiny, **own, **change).load()


def test_own_joints_need_a_step_and_others_have_none():
    for own in ({**OWN, "step_s": None}, {**OWN, "state": "xyz_rpy_opening"}):
        with pytest.raises(ValidationError, match="step_s must be given exactly"):
            OftConfig(checkpoint=Path("x"), proprio=True, **{**OPTIONS, "own_constants": own})


def test_every_other_platform_moves_the_tcp():
    for constants in ("libero", "bridge", "unknown", None):
        assert oft_space({"constants": constants}, ROBOT) is EE_DELTA
