"""Servo, controller "urdf" and simulated FR3 in one process at 10 Hz of simulated time; success is
decided by the simulator.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest

pytest.importorskip("rn_robot_fr3.simulation", exc_type=ImportError)
pytest.importorskip("rn_controller_urdf.controller", exc_type=ImportError)

from rn_backend_servo.backend import ServoBackend
from rn_controller_urdf.controller import UrdfController
from rn_robot_fr3.profile import profile
from rn_robot_fr3.simulation import JOINTS, STEP_S, ArmSimulation
from rn_simulation.engine import ENGINES
from roboneuron.contract import Action, ActionChunk, Frame, JointCommand, JointSample, Observation
from roboneuron.plugins.availability import is_importable

AVAILABLE = [engine for engine in ENGINES if is_importable(engine)]
TRIED = [*AVAILABLE[:1], *(pytest.param(name, marks=pytest.mark.slow) for name in AVAILABLE[1:])]
"""The engine used on robots; the others take as long again (rn-robot-fr3's tests compare the
engines).
"""
PERIOD_S = 0.1
ROBOT = profile()


class Cell:
    """The whole chain; images are one period older than the pose with them."""

    def __init__(self, simulation: ArmSimulation) -> None:
        self.simulation = simulation
        self.servo = ServoBackend(None)
        self.servo.load()
        self._controller = UrdfController(None, ROBOT)
        self._controller.load()
        self._frames = self._look()

    def _look(self) -> dict[str, Frame]:
        stamp_ns = round(self.simulation.time_s * 1e9)
        return {
            camera.role: Frame(
                camera=camera.name,
                image=self.simulation.render(camera.name),
                stamp_ns=stamp_ns,
                frame_id=camera.frame_id,
                calibration=camera.calibration,
            )
            for camera in ROBOT.cameras
        }

    def step(self, instruction: str) -> ActionChunk:
        """Run one period."""
        simulation = self.simulation
        frames = self._frames
        simulation.step(round(PERIOD_S / STEP_S))
        self._frames = self._look()
        joints = JointSample(
            names=JOINTS,
            position=simulation.joint_positions(),
            stamp_ns=round(simulation.time_s * 1e9),
        )
        chunk = self.servo.predict(
            Observation(
                frames=frames,
                instruction=instruction,
                joints=joints,
                ee_pose=self._controller.forward(joints),
                gripper_open=simulation.gripper_open(),
                stamp_ns=frames["primary"].stamp_ns,
            )
        )
        command = self._controller.compute(Action.from_vector(chunk.actions[0]), joints, PERIOD_S)
        assert isinstance(command, JointCommand), command
        simulation.set_target(command.names, command.position, command.duration_s)
        return chunk

    def run(
        self, instruction: str, until: Callable[[ActionChunk], bool], most_s: float = 25.0
    ) -> ActionChunk:
        """Step until `until` holds; fails after `most_s` of simulated time."""
        end_s = self.simulation.time_s + most_s
        while self.simulation.time_s < end_s:
            chunk = self.step(instruction)
            if until(chunk):
                return chunk
        pytest.fail(f"{instruction!r}: {most_s} s passed, last note: {chunk.note}")

    def is_held(self, colour: str) -> bool:
        """True by the simulator's own state: 10 cm above the table for a second."""
        return self.simulation.cubes()[colour].held_s >= 1.0


@pytest.fixture(params=TRIED)
def cell(request: pytest.FixtureRequest) -> Iterator[Cell]:
    with ArmSimulation(3, engine=request.param) as simulation:
        yield Cell(simulation)


@pytest.mark.slow
def test_named_cube_is_lifted_then_put_down_for_another(cell: Cell) -> None:
    cell.run("pick up the red cube", lambda _: cell.is_held("red"))
    assert all(
        cube.lifted_m < 0.005 for name, cube in cell.simulation.cubes().items() if name != "red"
    )
    last = cell.run("pick up the blue cube", lambda _: cell.is_held("blue"))
    assert last.note == "holding blue cube"
    assert cell.simulation.cubes()["red"].lifted_m < 0.005


@pytest.mark.exhaustive
def test_cube_that_is_moved_away_at_the_last_moment_is_found_again(cell: Cell) -> None:
    def is_about_to_grasp(chunk: ActionChunk) -> bool:
        return (
            chunk.note == "descending to green cube"
            and cell.simulation.tcp_pose().position_m[2] < 0.085
        )

    cell.run("grab the green block", is_about_to_grasp)
    cell.simulation.world.set_cubes({"green": ((0.42, -0.15, 0.0232), (0.0, 0.0, 0.0, 1.0))})
    last = cell.run("grab the green block", lambda _: cell.is_held("green"))
    assert last.metrics["failed_attempts"] == 1.0
