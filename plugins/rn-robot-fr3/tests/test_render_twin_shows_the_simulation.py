"""The cameras in their own process show the state of the physics, at its time and at the configured
rate.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from rn_robot_fr3.camera_source import SimulatedFr3Cameras
from rn_robot_fr3.cameras import cameras
from rn_robot_fr3.limits import FINGER_JOINT
from rn_robot_fr3.profile import profile
from rn_robot_fr3.simulation import ArmSimulation
from rn_simulation.arm_options import SimulatedCamerasOptions
from rn_simulation.engine import Engine
from rn_simulation.scene_state import TOPIC, SceneState, poses_of, to_message
from rn_testing.fakes import MemoryTopics
from roboneuron.contract import CameraProfile
from roboneuron.errors import ConfigurationError, NotReadyError, StateError

Open = Callable[..., SimulatedFr3Cameras]


def state_of(simulation: ArmSimulation, stamp_ns: int) -> SceneState:
    cubes = simulation.cubes()
    return SceneState(
        robot=simulation.cell.robot,
        engine=simulation.engine,
        seed=simulation.seed,
        cubes=tuple((cube.name, cube.edge_m) for cube in cubes.values()),
        joints=simulation.joint_positions(),
        cube_poses=poses_of(cubes),
        stamp_ns=stamp_ns,
    )


@pytest.fixture
def topics() -> MemoryTopics:
    return MemoryTopics()


@pytest.fixture
def opened(topics: MemoryTopics) -> Iterator[Open]:
    made = []

    def make(
        *, names: tuple[str, ...] = ("front", "wrist"), **options: object
    ) -> SimulatedFr3Cameras:
        chosen = tuple(camera for camera in profile().cameras if camera.name in names)
        source = SimulatedFr3Cameras(
            SimulatedCamerasOptions.model_validate(options), topics, chosen
        )
        source.open()
        made.append(source)
        return source

    yield make
    for source in made:
        source.close()


def test_twin_draws_the_same_pixels_as_the_physics(
    engine: Engine, topics: MemoryTopics, opened: Open
) -> None:
    source = opened(rate_hz=60)
    for seed in (0, 1):  # the second is a restarted driver with another scene
        with ArmSimulation(seed, engine=engine) as simulation:
            simulation.set_target(
                ["fr3_joint1", "fr3_joint4", FINGER_JOINT], [0.2, -2.0, 0.01], 0.3
            )
            simulation.step(120)
            topics.deliver(TOPIC, to_message(state_of(simulation, 1000 + seed)))
            for _ in cameras():
                frame = source.read(10.0)
                wanted = simulation.render(frame.camera).astype(float)
                # Equal except for a few pixels at edges, which depend on the last bit of a joint
                # angle.
                assert np.abs(frame.image - wanted).mean() < 0.05
                assert frame.stamp_ns == 1000 + seed
                assert frame.calibration is not None


def test_a_displaced_camera_shows_what_its_calibration_does_not_know(
    topics: MemoryTopics, opened: Open
) -> None:
    offset_m = (0.06, -0.03, 0.0)
    source = opened(rate_hz=60, displaced_m=offset_m)
    seen_from = [camera.displaced(offset_m) for camera in cameras()]
    with ArmSimulation(0, cameras=seen_from) as simulation:
        topics.deliver(TOPIC, to_message(state_of(simulation, 1000)))
        for camera in cameras():
            frame = source.read(10.0)
            wanted = simulation.render(frame.camera).astype(float)
            # as above
            assert np.abs(frame.image - wanted).mean() < 0.05
            assert frame.calibration is not None
            assert np.array_equal(frame.calibration.T_mount_camera, camera.T_mount_camera)


def test_cameras_take_turns_and_show_the_newest_state(topics: MemoryTopics, opened: Open) -> None:
    source = opened(rate_hz=60)
    with ArmSimulation(0, colours=("red",)) as simulation:
        seen = []
        for index in range(4):
            topics.deliver(TOPIC, to_message(state_of(simulation, 10 * index + 1)))
            topics.deliver(TOPIC, to_message(state_of(simulation, 10 * index + 2)))
            frame = source.read(10.0)
            seen.append((frame.camera, frame.stamp_ns, frame.frame_id))
    assert seen == [
        ("front", 2, "front_camera_optical_frame"),
        ("wrist", 12, "wrist_camera_optical_frame"),
        ("front", 22, "front_camera_optical_frame"),
        ("wrist", 32, "wrist_camera_optical_frame"),
    ]


def test_camera_without_a_simulation_names_the_missing_topic(opened: Open) -> None:
    with pytest.raises(NotReadyError, match="sim/state"):
        opened().read(0.05)


def test_frames_stop_when_the_simulation_stops(topics: MemoryTopics, opened: Open) -> None:
    source = opened(names=("front",), rate_hz=60)
    with ArmSimulation(0, colours=("red",)) as simulation:
        topics.deliver(TOPIC, to_message(state_of(simulation, 1)))
    source.read(10.0)
    with pytest.raises(NotReadyError, match="sim/state"):
        source.read(0.05)


def test_frames_come_no_faster_than_the_rate(topics: MemoryTopics, opened: Open) -> None:
    source = opened(names=("front",), rate_hz=20, width=32, height=32)
    with ArmSimulation(0, colours=("red",)) as simulation:
        message = to_message(state_of(simulation, 1))
    began_s = time.monotonic()
    for _ in range(6):
        topics.deliver(TOPIC, message)
        source.read(10.0)
    # counted from before the first one, which may be late: a busy machine only makes it longer
    assert time.monotonic() - began_s >= 4.9 / 20


def test_size_is_an_option_and_the_calibration_follows(topics: MemoryTopics, opened: Open) -> None:
    source = opened(names=("wrist",), width=64, height=48)
    with ArmSimulation(0, colours=("red",)) as simulation:
        topics.deliver(TOPIC, to_message(state_of(simulation, 1)))
    frame = source.read(10.0)
    assert frame.image.shape == (48, 64, 3)
    assert frame.calibration is not None
    np.testing.assert_allclose(frame.calibration.intrinsics[:2, 2], [32, 24])


def test_unknown_camera_is_refused_by_name(topics: MemoryTopics) -> None:
    stranger = CameraProfile(
        name="left", role="primary", frame_id="left_optical", width=8, height=8
    )
    with pytest.raises(ConfigurationError, match="left"):
        SimulatedFr3Cameras(None, topics, (stranger,)).open()


def test_close_ends_a_waiting_read(topics: MemoryTopics, opened: Open) -> None:
    source = opened()
    failures: list[Exception] = []

    def read() -> None:
        try:
            source.read(30.0)
        except StateError as error:
            failures.append(error)

    reader = threading.Thread(target=read)
    reader.start()
    source.close()
    reader.join(10.0)
    assert not reader.is_alive()
    assert len(failures) == 1
