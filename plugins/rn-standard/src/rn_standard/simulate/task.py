"""A task in a twin: the policy looks through the twin's cameras, and run_task's own rules judge
it.
"""

from __future__ import annotations

from collections.abc import Mapping

from rn_standard.simulate.arm import TwinArm
from rn_standard.simulate.twin_process import TwinProcess
from rn_standard.tasks.judging import PredicateJudge
from rn_standard.tasks.runner import Task, TaskEnd, TaskPlan
from rn_standard.tasks.snapshot import Snapshot, StillClock
from rn_standard.tasks.task_robot import PolicyState
from roboneuron import (
    EE_DELTA,
    BackendSpec,
    CameraProfile,
    Frame,
    Host,
    JointSample,
    Observation,
    Picture,
    RefusedError,
    RobotProfile,
)
from roboneuron.feature import Config

_CAMERA_S = 0.1
"""Period of images, and of the policy's actions."""


def policy_of(host: Host) -> tuple[BackendSpec, Mapping[str, object]]:
    """The backend that runs, or the configured one, and its options.

    Raises:
        RefusedError: there is none, or it needs a model, which a simulation does not load.
    """
    plan = host.modules.view("inference").plan
    config: Config = host.config if plan is None else plan.config
    if config.inference is None:
        raise RefusedError("No policy is configured.", rule="simulate")
    spec = host.registry.get(BackendSpec, config.inference.backend)
    if spec.family or spec.needs_checkpoint or spec.runtimes_required or spec.space is not None:
        raise RefusedError(
            f"A task of {spec.name!r} cannot be simulated: its model is not loaded a second time, "
            "nor asked for a scene that there is not.",
            hint="Simulate single motions: move_ee, move_joints, move_to.",
            rule="simulate",
        )
    return spec, config.options(spec.name)


class TwinCell:
    """Follows the protocol `Cell`, by the clock of a twin."""

    def __init__(
        self, arm: TwinArm, twin: TwinProcess, spec: BackendSpec, profile: RobotProfile
    ) -> None:
        """Args:
        arm, twin: of the simulation; the twin has loaded the policy.
        spec: of the policy.
        profile: of the robot.
        """
        self._arm, self._twin, self._gripper = arm, twin, profile.gripper
        wanted = (*spec.cameras, *spec.optional_cameras)
        self._cameras = [camera for camera in profile.cameras if camera.role in wanted]
        self._still = StillClock(kinds=profile.kinds)
        self._instruction, self._failure = "", ""
        self._has_acted, self._is_done = False, False
        self._due_s = 0.0
        self._frames: dict[str, Frame] = {}

    def now_s(self) -> float:
        """See `Cell`."""
        return self._arm.passed_s

    def wait(self, seconds: float) -> bool:
        """See `Cell`; nobody ends a simulation but its bound. Raises TooLongError."""
        end_s = self.now_s() + seconds
        while self.now_s() < end_s - 1e-9:
            if self._instruction and self.now_s() >= self._due_s - 1e-9:
                self._due_s = self.now_s() + _CAMERA_S
                self._act()
            self._arm.advance(min(end_s, max(self._due_s, self.now_s() + 0.01)) - self.now_s())
        return False

    def begin(self, instruction: str) -> None:
        """See `Cell`."""
        self._twin.begin_task()
        self._instruction, self._failure = instruction, ""
        self._has_acted, self._is_done = False, False
        self._due_s = self.now_s()

    def policy(self) -> PolicyState:
        """See `Cell`."""
        return PolicyState(has_acted=self._has_acted, failure=self._failure)

    def look(self) -> Snapshot:
        """See `Cell`."""
        joints = self._twin.joints()
        measured = dict(zip(joints.names, joints.position.tolist(), strict=True))
        return Snapshot(
            now_s=self.now_s(),
            joints=measured,
            tcp=self._arm.poses()[0],
            gripper_open=None if self._gripper is None else self._gripper.opening_in(joints),
            still_s=self._still.observe(self.now_s(), measured),
            policy_done=self._is_done if self._has_acted else None,
            frames=self._frames or self._observe(joints),
        )

    def end(self) -> None:
        """See `Cell`."""
        self._instruction = ""
        self._arm.hold()

    def evidence(self, when: str) -> tuple[Picture, ...]:
        """See `Cell`; the simulation takes a picture of its own."""
        return ()

    def _act(self) -> None:
        """A camera period: new images, and an action for them."""
        joints = self._twin.joints()
        frames = self._observe(joints)
        observation = Observation(
            frames=frames,
            instruction=self._instruction,
            stamp_ns=joints.stamp_ns + 1,
            joints=joints,
            ee_pose=self._arm.poses()[0],
            gripper_open=None if self._gripper is None else self._gripper.opening_in(joints),
        )
        chunk, self._failure = self._twin.predict(observation)
        if chunk is None:
            self._arm.hold()
            return
        self._has_acted = True
        self._is_done = chunk.metrics.get("done", 0.0) >= 0.5
        self._arm.command(EE_DELTA, chunk.actions[0], _CAMERA_S)

    def _observe(self, joints: JointSample) -> dict[str, Frame]:
        self._frames = {
            camera.role: self._frame(camera, joints.stamp_ns + 1) for camera in self._cameras
        }
        return self._frames

    def _frame(self, camera: CameraProfile, stamp_ns: int) -> Frame:
        return Frame(
            camera=camera.name,
            image=self._twin.picture(camera.name, camera.width, camera.height),
            stamp_ns=stamp_ns,
            frame_id=camera.frame_id,
            calibration=camera.calibration,
        )


def run_in_twin(
    host: Host,
    arm: TwinArm,
    twin: TwinProcess,
    profile: RobotProfile,
    judge: PredicateJudge | None,
    plan: TaskPlan,
) -> TaskEnd:
    """Carry out a task. Raises RefusedError as `policy_of`, and NotReadyError when the policy
    cannot be loaded.
    """
    spec, options = policy_of(host)
    twin.load_policy(spec, options)
    return Task(TwinCell(arm, twin, spec, profile), judge, plan, lambda _: None).run()
