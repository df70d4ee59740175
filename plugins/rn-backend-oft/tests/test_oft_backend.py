from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
import torch
from pydantic import ValidationError

from rn_backend_oft.backend import OftBackend, OftPrimaryBackend
from rn_backend_oft.cli import main
from rn_backend_oft.config import OftConfig
from rn_backend_oft.state import read_state
from rn_backend_oft.tiny import make_tiny_oft
from rn_runtime_torch.config import TorchRuntimeConfig
from rn_runtime_torch.runtime import TorchRuntime
from rn_vla.decoding import RowsReply
from rn_vla.openvla.tiny import write_tokenizer
from rn_vla.rotation import matrix_from_rpy
from roboneuron.contract import Frame, Observation, Pose
from roboneuron.contract.rotation import matrix_from_rotvec, quaternion_from_matrix
from roboneuron.errors import CheckpointError, ConfigurationError, UngroundedError, UnsafeError

POSE = Pose(
    position_m=np.array([0.4, -0.1, 0.3]),
    quaternion_xyzw=quaternion_from_matrix(matrix_from_rotvec(np.array([0.2, -1.1, 0.4]))),
)


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    path = tmp_path_factory.mktemp("tiny") / "oft"
    make_tiny_oft(path)
    return path


def _backend(path, kind=OftBackend, **options) -> OftBackend:
    options = {"profile": "libero", "constants": "libero", "proprio": True} | options
    runtime = TorchRuntime(TorchRuntimeConfig(device="cpu", dtype="float32"))
    return kind(OftConfig(checkpoint=path, **options), runtime=runtime)


@pytest.fixture
def backend(tiny) -> OftBackend:
    made = _backend(tiny)
    made.load()
    return made


@pytest.fixture
def complete(golden_copy):
    """The golden checkpoint with a tokenizer."""
    write_tokenizer(golden_copy / "tokenizer.json")
    return golden_copy


def _observation(primary: int = 60, wrist: int = 90, **changes) -> Observation:
    frames = {
        role: Frame(
            camera=role,
            image=np.full((224, 224, 3), value, dtype=np.uint8),
            stamp_ns=1,
            frame_id=f"{role}_optical",
        )
        for role, value in (("primary", primary), ("wrist", wrist))
    }
    given = {
        "frames": frames,
        "instruction": "pick up the cube",
        "ee_pose": POSE,
        "gripper_open": 1.0,
    } | changes
    return Observation(**given)


def test_a_chunk_of_eight_actions_comes_at_the_step_of_the_profile(backend):
    chunk = backend.predict(_observation())
    assert chunk.actions.shape == (8, 7)
    assert chunk.step_s == 0.05
    assert chunk.metrics["visual_tokens"] == chunk.metrics["tokens_kept"] == 512


def test_black_and_white_images_give_different_actions_for_each_camera(backend):
    """Guards against the silent failure in which an image never reaches the model."""
    base = backend.predict(_observation(0, 0)).actions
    for primary, wrist in ((255, 0), (0, 255)):
        assert np.abs(backend.predict(_observation(primary, wrist)).actions - base).max() > 1e-4


def test_the_measured_state_counts(backend):
    other = dataclasses.replace(POSE, position_m=POSE.position_m + 0.5)
    assert (
        np.abs(
            backend.predict(_observation()).actions
            - backend.predict(_observation(ee_pose=other)).actions
        ).max()
        > 0
    )


def test_execute_plays_only_the_first_actions(tiny, backend):
    short = _backend(tiny, execute=3)
    short.load()
    np.testing.assert_array_equal(
        short.predict(_observation()).actions, backend.predict(_observation()).actions[:3]
    )


def test_one_camera_checkpoints_use_the_primary_image_only(tiny):
    backend = _backend(tiny, OftPrimaryBackend)
    backend.load()
    chunk = backend.predict(_observation())
    assert chunk.metrics["visual_tokens"] == 256
    np.testing.assert_array_equal(chunk.actions, backend.predict(_observation(wrist=7)).actions)


@pytest.mark.parametrize("missing", ["primary", "wrist"])
def test_a_missing_camera_is_named(backend, missing):
    observation = _observation()
    frames = {role: frame for role, frame in observation.frames.items() if role != missing}
    with pytest.raises(UngroundedError, match=f"role '{missing}'"):
        backend.predict(dataclasses.replace(observation, frames=frames))


@pytest.mark.parametrize(
    ("field", "words"), [("ee_pose", "TCP pose"), ("gripper_open", "gripper opening")]
)
def test_a_missing_state_is_named_and_nothing_is_put_in_its_place(backend, field, words):
    with pytest.raises(UngroundedError, match=words):
        backend.predict(_observation(**{field: None}))


def test_state_of_libero_is_position_rotation_vector_and_fingers():
    state = read_state(
        _observation(gripper_open=0.5),
        "xyz_rotvec_fingers",
        finger_travel_m=0.04,
        origin_m=np.array([1.0, 0, 0]),
    )
    np.testing.assert_allclose(state, [1.4, -0.1, 0.3, 0.2, -1.1, 0.4, 0.02, -0.02], atol=1e-12)


@pytest.mark.parametrize("tilt_rad", [-0.1, 0.0, 0.1])
def test_state_of_libero_runs_through_pi_where_the_gripper_points_down(tilt_rad):
    rotation = matrix_from_rotvec(np.array([np.pi + tilt_rad, 0.0, 0.0]))
    pose = Pose(position_m=np.zeros(3), quaternion_xyzw=quaternion_from_matrix(rotation))
    state = read_state(
        _observation(ee_pose=pose), "xyz_rotvec_fingers", finger_travel_m=0.04, origin_m=np.zeros(3)
    )
    np.testing.assert_allclose(state[3:6], [np.pi + tilt_rad, 0, 0], atol=1e-7)


def test_state_of_bridge_is_position_angles_against_gripper_down_and_opening():
    down_then_turned = matrix_from_rpy(np.array([0.1, -0.2, 0.3])) @ np.diag([1.0, -1.0, -1.0])
    pose = Pose(
        position_m=np.array([0.4, -0.1, 0.3]),
        quaternion_xyzw=quaternion_from_matrix(down_then_turned),
    )
    state = read_state(
        _observation(ee_pose=pose), "xyz_rpy_opening", finger_travel_m=0.04, origin_m=np.zeros(3)
    )
    np.testing.assert_allclose(state, [0.4, -0.1, 0.3, 0.1, -0.2, 0.3, 1.0], atol=1e-9)


def test_constants_that_do_not_fit_the_head_are_refused(complete):
    """The head does not reveal a bridge chunk of five instead of LIBERO's, but its state width
    does.
    """
    with pytest.raises(ConfigurationError, match="8 proprio values"):
        _backend(complete, constants="bridge").load()


def test_own_constants_are_said_field_by_field(tiny):
    own = {"chunk": 4, "state": "xyz_rotvec_fingers", "bounds": "minmax"}
    backend = _backend(tiny, constants="own", own_constants=own)
    backend.load()
    assert backend.predict(_observation()).actions.shape == (4, 7)


def test_a_checkpoint_without_head_decodes_bins(complete):
    for file in complete.glob("*_checkpoint.pt"):
        file.unlink()
    # random weights decode any id
    backend = _backend(complete, head="tokens", proprio=False, max_outside_share=1.0)
    backend.load()
    assert backend.predict(_observation()).actions.shape == (8, 7)


@pytest.mark.parametrize(("outside", "refused"), [(0, False), (8, False), (9, True), (56, True)])
def test_tokens_that_are_no_actions_are_counted_over_the_chunk_and_refused_above_the_share(
    complete, outside, refused
):
    for file in complete.glob("*_checkpoint.pt"):
        file.unlink()
    backend = _backend(complete, head="tokens", proprio=False)
    backend.load()
    tokens = np.full(56, 31900, dtype=np.float32)
    tokens[:outside] = 17
    backend._runtime.run = lambda request: RowsReply(values=tokens)
    if refused:
        with pytest.raises(UngroundedError, match=f"{outside} of 56 tokens are not action tokens"):
            backend.predict(_observation())
        return
    chunk = backend.predict(_observation())
    assert chunk.metrics["tokens_outside_actions"] == outside
    assert bool(chunk.note) == bool(outside)


@pytest.mark.parametrize("component", ["action_head", "proprio_projector"])
def test_a_missing_component_file_is_named(complete, component):
    next(complete.glob(f"{component}*")).unlink()
    with pytest.raises(CheckpointError, match=rf"exactly one file {component}.*found: none"):
        _backend(complete).load()


def test_two_files_of_one_component_are_not_chosen_between(complete):
    (complete / "action_head--2_checkpoint.pt").write_bytes(b"")
    with pytest.raises(
        CheckpointError, match=r"action_head--1_checkpoint\.pt, action_head--2_checkpoint\.pt"
    ):
        _backend(complete).load()


@pytest.mark.parametrize(
    ("options", "words"),
    [({"head": "tokens"}, 'head = "l1"'), ({"proprio": False}, "proprio = true")],
)
def test_a_component_that_would_be_left_out_is_refused(complete, options, words):
    with pytest.raises(CheckpointError, match=words):
        _backend(complete, **options).load()


@pytest.mark.parametrize(
    ("file", "words"),
    [
        ("noisy_action_projector--9_checkpoint.pt", "diffusion head"),
        ("vision_backbone--9_checkpoint.pt", "FiLM"),
    ],
)
def test_diffusion_and_film_are_refused_plainly(complete, file, words):
    (complete / file).write_bytes(b"")
    with pytest.raises(CheckpointError, match=rf"{words}.*not implemented"):
        _backend(complete).load()


def test_a_head_of_another_model_is_refused_by_its_tensors(complete):
    path = next(complete.glob("action_head*"))
    tensors = torch.load(path, weights_only=True)
    tensors["module.noise_predictor.fc1.weight"] = tensors.pop("module.model.fc1.weight")
    torch.save(tensors, path)
    with pytest.raises(
        CheckpointError, match=r"1 missing: module\.model\.fc1\.weight.*1 unexpected: module\.noise"
    ):
        _backend(complete).load()


def test_a_truncated_component_is_named(complete):
    path = next(complete.glob("proprio_projector*"))
    path.write_bytes(path.read_bytes()[:-900])
    with pytest.raises(
        CheckpointError, match=r"proprio_projector--1_checkpoint\.pt .*truncated or damaged"
    ):
        _backend(complete).load()


def test_a_wrong_data_set_is_refused_with_the_choices(complete):
    with pytest.raises(
        ConfigurationError, match=r"dataset_statistics\.json.*Choose one of: toy_suite"
    ):
        _backend(complete, unnorm_key="bridge_orig").load()


def test_statistics_without_proprio_are_refused(complete):
    path = complete / "dataset_statistics.json"
    statistics = json.loads(path.read_text())
    del statistics["toy_suite"]["proprio"]
    path.write_text(json.dumps(statistics))
    with pytest.raises(ConfigurationError, match="none proprio values"):
        _backend(complete).load()


def test_a_model_that_produces_nan_gives_no_actions(backend):
    backend._runtime._engine._back.fc2.bias.data.fill_(torch.nan)
    with pytest.raises(UnsafeError):
        backend.predict(_observation())


def test_more_actions_than_a_chunk_cannot_be_executed(tiny):
    with pytest.raises(ValidationError, match="chunk holds 8"):
        _backend(tiny, execute=9)


def test_make_tiny_writes_a_checkpoint_that_loads(tmp_path, capsys):
    assert main(["make-tiny", str(tmp_path / "made")]) == 0
    assert "constants" in capsys.readouterr().out
    _backend(tmp_path / "made").load()
    assert main(["make-tiny", str(tmp_path / "made")]) == 2


def test_what_the_runtime_says_of_an_answer_reaches_the_status(tiny, monkeypatch):
    backend = _backend(tiny)
    backend.load()
    run = backend._runtime.run
    monkeypatch.setattr(
        backend._runtime,
        "run",
        lambda request: dataclasses.replace(run(request), note="CUDA graph: eager."),
    )
    assert backend.predict(_observation()).note == "CUDA graph: eager."
