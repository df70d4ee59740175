"""Backend "servo-pair", controller "urdf", the gate's limits and two simulated FR3s in one process,
at 10 Hz of simulated time; success is decided by the simulator.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("rn_robot_fr3.simulation", exc_type=ImportError)
pytest.importorskip("rn_controller_urdf.controller", exc_type=ImportError)

from rn_backend_servo.case import pair_case
from rn_backend_servo.options import HandOverOptions
from rn_backend_servo.pair_backend import HandOverBackend, hand_over_space
from rn_backend_servo.sight import look
from rn_controller_urdf.controller import UrdfController
from rn_robot_fr3.cell import PAIR
from rn_robot_fr3.profile import pair_profile
from rn_robot_fr3.profile import profile as single_profile
from rn_robot_fr3.simulation import STEP_S, ArmSimulation
from rn_simulation.engine import ENGINES
from rn_testing import BackendCase, BackendContract, effects
from rn_testing.rule import RuleVerdict
from rn_testing.rules import RULES
from rn_testing.verification import verify
from roboneuron.config import LimitsConfig
from roboneuron.contract import (
    ActionChunk,
    ArmState,
    Frame,
    JointCommand,
    JointSample,
    Observation,
)
from roboneuron.errors import InvalidInputError, UngroundedError
from roboneuron.gate.motion import MotionLimiter, motion_rules
from roboneuron.modules.inference.agreement import agree
from roboneuron.plugins.availability import is_importable

MEMORY = next(rule for rule in RULES["backend"] if rule.id == "backend/memory-bounded")
AVAILABLE = [engine for engine in ENGINES if is_importable(engine)]
TRIED = [*AVAILABLE[:1], *(pytest.param(name, marks=pytest.mark.slow) for name in AVAILABLE[1:])]
"""The engine used on robots; the others take as long again (rn-robot-fr3's tests compare the
engines).
"""
PERIOD_S = 0.1
ROBOT = pair_profile()


class PairCell:
    """The whole chain for two arms; images are one period older than the poses with them."""

    def __init__(self, simulation: ArmSimulation) -> None:
        self.simulation = simulation
        self.backend = HandOverBackend(None)
        self.backend.load()
        controller = UrdfController(None, ROBOT)
        controller.load()
        self._controller = controller
        self._limiter = MotionLimiter(
            motion_rules(LimitsConfig(), ROBOT),
            ROBOT,
            controller.forward,
            controller.inspect,
            poses=controller.poses,
        )
        self._agreement = agree(
            hand_over_space({}, ROBOT), ROBOT, ("ee_pose",), backend="servo-pair", controller="urdf"
        )
        self.refused: list[str] = []
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
            if camera.role in ("primary", "wrist")
        }

    def step(self, instruction: str) -> ActionChunk:
        """Run one period."""
        simulation, frames = self.simulation, self._frames
        simulation.step(round(PERIOD_S / STEP_S))
        self._frames = self._look()
        joints = JointSample(
            names=PAIR.joints,
            position=simulation.joint_positions(),
            stamp_ns=round(simulation.time_s * 1e9),
        )
        by_name = dict(zip(joints.names, joints.position.tolist(), strict=True))
        arms = {
            arm.name: ArmState(
                ee_pose=pose, gripper_open=arm.gripper.to_opening(by_name[arm.gripper.joint])
            )
            for arm, pose in zip(ROBOT.arms, self._controller.poses(joints), strict=True)
            if arm.gripper is not None
        }
        chunk = self.backend.predict(
            Observation(
                frames=frames,
                instruction=instruction,
                joints=joints,
                ee_pose=arms["left"].ee_pose,
                gripper_open=arms["left"].gripper_open,
                arms=arms,
                stamp_ns=frames["primary"].stamp_ns,
            )
        )
        rows = self._agreement.convert(chunk, joints)
        reference = self._limiter.reference(joints, simulation.time_s)
        command = self._controller.execute(rows.space, rows.actions[0], reference, PERIOD_S)
        assert isinstance(command, JointCommand), command
        verdict = self._limiter.limit(command, joints, simulation.time_s)
        if isinstance(verdict.command, JointCommand):
            sent = verdict.command
            simulation.set_target(sent.names, sent.position, sent.duration_s)
        else:
            self.refused.append(verdict.reason)
        return chunk


class TestServoPair(BackendContract):
    @pytest.fixture
    def plugin(self) -> BackendCase:
        return pair_case()


@pytest.mark.exhaustive
def test_its_memory_is_judged_on_a_quick_machine_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where `predict` is quick, the rule calls it more often than one episode takes."""
    monkeypatch.setattr(effects, "QUICK_S", 60.0)
    outcome = verify(MEMORY, pair_case())
    assert outcome.verdict is RuleVerdict.PASSED, outcome


@pytest.mark.exhaustive
@pytest.mark.parametrize("engine", TRIED)
def test_a_cube_goes_from_the_left_hand_to_the_right(engine: str) -> None:
    with ArmSimulation(3, engine=engine, cell=PAIR) as simulation:  # type: ignore[arg-type]
        cell = PairCell(simulation)
        notes: list[str] = []
        while simulation.time_s < 60.0:
            note = cell.step("hand over the red cube").note
            if not notes or notes[-1] != note:
                notes.append(note)
            red = simulation.cubes()["red"]
            if red.handed_over_s >= 1.0:
                break
        assert red.holders == ("right",), (notes, cell.refused[-3:])
        assert red.handed_over_s >= 1.0, notes
        assert red.held_s > red.handed_over_s, "it was in the air all the time"
        assert notes[-1] == "handed over red cube"


def _after_some_steps(simulation: ArmSimulation) -> PairCell:
    """A cell in which the giver is moving to the cube."""
    cell = PairCell(simulation)
    for _ in range(8):
        cell.step("hand over the red cube")
    return cell


def _carry_on(cell: PairCell) -> None:
    for _ in range(12):
        cell.step("hand over the red cube")


def test_a_camera_that_froze_while_the_giver_moves_is_refused() -> None:
    with ArmSimulation(3, cell=PAIR) as simulation:
        cell = _after_some_steps(simulation)
        frozen = cell._frames["primary"].image
        look = cell._look
        cell._look = lambda: {  # type: ignore[method-assign]
            role: replace(frame, image=frozen) if role == "primary" else frame
            for role, frame in look().items()
        }
        with pytest.raises(UngroundedError, match="'front' is frozen: it has not changed"):
            _carry_on(cell)


def test_an_image_that_comes_again_is_refused() -> None:
    with ArmSimulation(3, cell=PAIR) as simulation:
        cell = _after_some_steps(simulation)
        cell._look = lambda: before  # type: ignore[method-assign]
        before = cell._frames
        cell.step("hand over the red cube")
        with pytest.raises(UngroundedError, match="is the previous one"):
            cell.step("hand over the red cube")


def test_a_cube_is_seen_by_the_camera_of_the_second_hand_where_it_is() -> None:
    """The right arm gives: its own camera is located by its own TCP."""
    with ArmSimulation(3, cell=PAIR) as simulation:
        controller = UrdfController(None, ROBOT)
        controller.load()
        joints = JointSample(names=PAIR.joints, position=simulation.joint_positions(), stamp_ns=1)
        tcps = dict(zip(("left", "right"), controller.poses(joints), strict=True))
        camera = next(camera for camera in ROBOT.cameras if camera.role == "right_wrist")
        frame = Frame(
            camera=camera.name,
            image=simulation.render(camera.name),
            stamp_ns=1,
            frame_id=camera.frame_id,
            calibration=camera.calibration,
        )
        assert camera.calibration is not None
        assert camera.calibration.arm == "right"
        seen = [
            (name, np.array([sighting.estimate.x_m, sighting.estimate.y_m]))
            for name in simulation.cubes()
            if (
                sighting := look(
                    {camera.role: frame},
                    {camera.role: tcps["right"].matrix},
                    name,
                    HandOverOptions(),
                )
            )
            and sighting.estimate.is_clear
        ]
        assert seen, "no cube lies in front of the right hand in this scene"
        for name, centre_m in seen:
            at_m = simulation.cubes()[name].position_m
            assert np.linalg.norm(centre_m - at_m[:2]) < 0.02, name


@pytest.mark.parametrize("instruction", ["pick up the red cube", "hand over the cube", "dance"])
def test_other_instructions_are_refused(instruction: str) -> None:
    with ArmSimulation(3, cell=PAIR) as simulation, pytest.raises(UngroundedError):
        PairCell(simulation).step(instruction)


def test_a_robot_without_these_arms_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="Robot 'fr3' has no arm 'left'"):
        hand_over_space({}, single_profile())


def test_the_arms_may_change_their_parts() -> None:
    """Channels are named, so the order of the arms does not matter."""
    chosen = HandOverOptions(giver="right", taker="left")
    declared = hand_over_space(chosen.model_dump(), ROBOT)
    agreement = agree(declared, ROBOT, ("ee_pose",), backend="servo-pair", controller="urdf")
    assert agreement.columns == (*range(8, 16), *range(8))
