"""Shards are repeatable, their labels are the teacher's, and the teacher lifts cubes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rn_controller_urdf.controller import UrdfController
from rn_policy_cubes.dataset import Shards, draw, every, relit, sampling
from rn_policy_cubes.demonstrations import COLOURS, ROW, shard_files, situations, write_shard
from rn_policy_cubes.labels import PLACE_SCALE, coloured_share, label, patches_of, state_of
from rn_policy_cubes.recipe import ACTION_SCALE, PATCHES, ROWS
from rn_policy_cubes.teacher import STEP_S, Situations, chunks, tilt_of, yaw_of
from rn_policy_cubes.words import Prompts
from rn_robot_fr3.profile import profile
from rn_robot_fr3.simulation import JOINTS, ArmSimulation
from rn_simulation.cubes import RGBA_BY_COLOUR
from roboneuron import Action, Hold, JointSample, matrix_from_quaternion


def test_a_shard_repeats_bit_for_bit(shards: Path, tmp_path: Path) -> None:
    write_shard(tmp_path, 1, len(np.load(shard_files(shards, 1)[0])))
    for made, again in zip(shard_files(shards, 1), shard_files(tmp_path, 1), strict=True):
        assert made.read_bytes() == again.read_bytes()


def test_different_shards_are_of_different_scenes(shards: Path) -> None:
    seeds = [set(np.load(shard_files(shards, number)[0])["seed"]) for number in range(2)]
    assert not seeds[0] & seeds[1]
    assert min(seeds[0] | seeds[1]) >= 1_000_000


def test_pictures_show_the_cubes_where_the_rows_say(shards: Path) -> None:
    from rn_robot_fr3.cameras import cameras

    rows, pictures = (np.load(path) for path in shard_files(shards, 0))
    calibration = next(camera for camera in cameras() if camera.name == "front").calibration(
        224, 224
    )
    share = coloured_share(patches_of(pictures))
    hits = 0
    for row, view in zip(rows, share, strict=True):
        for cube in range(len(COLOURS)):
            eye = np.linalg.inv(calibration.T_mount_camera) @ [*row["cube_m"][cube], 1.0]
            u, v, depth = calibration.intrinsics @ eye[:3]
            patch = int(v / depth // 14) * 16 + int(u / depth // 14)
            hits += view[patch, cube] > 0.05
    assert hits > 0.8 * rows.size * len(COLOURS)  # the arm hides some


def test_patches_are_cut_as_a_vision_tower_cuts_them() -> None:
    picture = np.random.default_rng(0).integers(0, 256, (1, 224, 224, 3), dtype=np.uint8)
    patches = patches_of(picture)
    assert patches.shape == (1, PATCHES, 588)
    expected = picture[0, 14 * 3 : 14 * 4, 14 * 5 : 14 * 6].transpose(2, 0, 1)
    assert (patches[0, 3 * 16 + 5].reshape(3, 14, 14) == expected).all()


def test_the_colours_of_the_simulator_are_told_apart() -> None:
    for index, colour in enumerate(COLOURS):
        for shade in (0.55, 1.0):
            pixel = (np.array(RGBA_BY_COLOUR[colour][:3]) * 255 * shade).astype(np.uint8)
            patch = np.repeat(pixel, 196)[None, None]
            assert coloured_share(patch)[0, 0].tolist() == [
                float(other == index) for other in range(len(COLOURS))
            ]


def test_labels_have_the_shapes_of_the_layout_and_are_the_teachers(shards: Path) -> None:
    rows = np.load(shard_files(shards, 0)[0])
    labels = label(rows)
    assert labels.state.shape == (len(rows), 7)
    assert labels.actions.shape == (len(rows), len(COLOURS), ROWS, 7)
    told = chunks(situations(rows, 2), ROWS)
    assert np.allclose(labels.actions[:, 2, :, :6] * ACTION_SCALE, told[..., :6], atol=1e-6)
    assert np.allclose(
        labels.place[:, 2, :3] / PLACE_SCALE, rows["cube_m"][:, 2] - rows["tcp_m"], atol=1e-6
    )
    assert (np.abs(labels.state) <= 1).all()
    assert np.array_equal(state_of(rows[3]), labels.state[3])


def test_the_yaw_to_be_seen_is_the_cubes_alone_and_a_quarter_turn_changes_nothing(
    shards: Path,
) -> None:
    rows = np.load(shard_files(shards, 0)[0])[:1].repeat(3)
    rows["rotation"] = np.diag([1.0, -1.0, -1.0])
    turned = 0.3
    sine, cosine = np.sin(turned), np.cos(turned)
    rows["rotation"][1] = [[cosine, sine, 0.0], [sine, -cosine, 0.0], [0.0, 0.0, -1.0]]
    rows["cube_yaw_rad"] = 0.1
    rows["cube_yaw_rad"][2] += np.pi / 2
    place = label(rows).place
    assert np.allclose(place[:, :, 5:], [np.sin(0.4), np.cos(0.4)], atol=1e-6)
    assert np.allclose(place[0], place[2], atol=1e-6)
    to_cube = 4 * (0.1 - turned)
    assert np.allclose(place[1, :, 3:5], [np.sin(to_cube), np.cos(to_cube)], atol=1e-6)


def test_from_above_the_gripper_is_turned_to_where_the_cube_alone_says(shards: Path) -> None:
    rows = np.load(shard_files(shards, 0)[0])[:1].repeat(2)
    rows["tcp_m"], rows["cube_m"], rows["cube_yaw_rad"] = [0.5, 0.0, 0.3], [0.5, 0.0, 0.02], 0.7
    for row, yaw_rad in zip(rows, [-0.6, 0.2], strict=True):
        sine, cosine = np.sin(yaw_rad), np.cos(yaw_rad)
        row["rotation"] = [[cosine, sine, 0.0], [sine, -cosine, 0.0], [0.0, 0.0, -1.0]]
    assert situations(rows, 0).turn_rad == pytest.approx([1.3, 0.5], abs=1e-6)
    # with the cube between the fingers, a turn by more than an eighth would push it away
    rows["tcp_m"] = rows["cube_m"][:, 0]
    assert situations(rows, 0).turn_rad == pytest.approx([1.3 - np.pi / 2, 0.5], abs=1e-6)


def test_a_held_cube_leaves_no_answer_for_the_others() -> None:
    rows = np.zeros(1, dtype=ROW)
    rows["rotation"] = np.diag([1.0, -1.0, -1.0])
    rows["cube_m"] = [[0.5, 0.2, 0.02], [0.5, 0.0, 0.02], [0.6, 0.1, 0.02], [0.4, 0.1, 0.02]]
    rows["tcp_m"], rows["edge_m"], rows["opening"], rows["target"] = (
        rows["cube_m"][:, 1],
        0.044,
        0.55,
        1,
    )
    assert label(rows).known.tolist() == [[False, True, False, False]]
    rows["opening"] = 1.0
    assert label(rows).known.all()


def test_a_batch_keeps_every_cube_and_weighs_the_rest(shards: Path, prompts: Prompts) -> None:
    loaded = Shards.load(shards, [0])
    batch = draw(loaded, prompts, sampling(loaded), 5, 24, [0, 3])
    assert batch.look.weight is not None
    assert batch.look.weight.sum(dim=1).numpy() == pytest.approx(PATCHES)
    assert (batch.look.index.diff(dim=1) > 0).all()
    whole = every(loaded, prompts, 8)[0]
    assert whole.look.weight is None
    assert whole.look.index.shape == (8, PATCHES)
    assert int(batch.shows_named.sum()) > 0
    again = draw(loaded, prompts, sampling(loaded), 5, 24, [0, 3])
    assert (again.look.pixels == batch.look.pixels).all()
    assert (again.state == batch.state).all()


def test_views_in_another_light_are_as_many_as_asked_for_and_repeat() -> None:
    grey = np.full((200, 4, 588), 120, dtype=np.uint8)
    changed = relit(grey, 0.6, np.random.default_rng(5))
    assert (changed == relit(grey, 0.6, np.random.default_rng(5))).all()
    is_changed = (changed != grey).any(axis=(1, 2))
    assert 100 <= is_changed.sum() <= 140
    # brightness 0.55 to 1.15, each channel within 15 % of it, and noise that averages out
    gains = changed[is_changed].reshape(-1, 4, 3, 196).mean(axis=(1, 3)) / 120
    assert gains.min() > 0.55 * 0.85 - 0.02
    assert gains.max() < 1.15 * 1.15 + 0.02
    assert gains.std(axis=1).max() > 0.05
    assert (relit(grey, 0.0, np.random.default_rng(5)) == grey).all()


def _now(
    simulation: ArmSimulation, target: str, error_m: np.ndarray[tuple[int], np.dtype[np.float64]]
) -> Situations:
    cube, pose = simulation.cubes()[target], simulation.tcp_pose()
    rotation = matrix_from_quaternion(pose.quaternion_xyzw)
    held = (
        np.linalg.norm(cube.position_m - pose.position_m) < 0.03 and simulation.gripper_open() < 0.8
    )
    return Situations(
        tcp_m=pose.position_m[None],
        yaw_rad=np.array([np.arctan2(rotation[1, 0], rotation[0, 0])]),
        tilt_rad=tilt_of(rotation[None]),
        opening=np.array([simulation.gripper_open()]),
        cube_m=(cube.position_m + (0.0 if held else error_m))[None],
        cube_yaw_rad=np.array([yaw_of(matrix_from_quaternion(cube.quaternion_xyzw)) + 0.25]),
        edge_m=np.array([cube.edge_m]),
    )


@pytest.mark.parametrize("seed", [1, 2])
def test_the_teacher_lifts_a_cube_although_it_sees_it_beside_and_turned(seed: int) -> None:
    controller = UrdfController(None, profile())
    controller.load()
    target = COLOURS[seed]
    with ArmSimulation(seed) as simulation:
        while simulation.time_s < 15.0 and simulation.cubes()[target].held_s < 1.0:
            for action in chunks(_now(simulation, target, np.array([0.006, -0.006, 0.0])), ROWS)[0]:
                joints = JointSample(
                    names=JOINTS, position=simulation.joint_positions(), stamp_ns=0
                )
                command = controller.compute(Action.from_vector(action), joints, STEP_S)
                assert not isinstance(command, Hold)
                simulation.set_target(command.names, command.position, command.duration_s)
                simulation.step(24)
        assert simulation.cubes()[target].held_s >= 1.0
