"""A stand-in for MoveIt's move_group that moves a simulated FR3: the actions `move_action` and
`execute_trajectory` over `joint_states` and `joint_trajectory`.

    roboneuron ros learn examples/ros      # once: MoveGroup, ExecuteTrajectory
    python examples/moveit_standin.py --namespace fr3

It plans a straight line in joint space from the measured position, with the goal's scaling factors
of the joint limits, and without obstacles. Goals that cannot be planned or executed are aborted
with the error code of the definition; cancelling one holds the arm; while one runs, others are
rejected. A scaling factor outside of 0 .. 1 counts as 1, and a start state is ignored unless the
goal is to plan only. Source: the definitions of moveit_msgs 2.6 and MoveIt's documentation.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio
from builtin_interfaces.msg import Duration
from numpy.typing import NDArray
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node
from rclpy.task import Future
from sensor_msgs.msg import JointState
from standin_node import run_node, to_duration
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from rn_controller_urdf.arm import ArmKinematics
from rn_controller_urdf.options import UrdfControllerOptions
from rn_interfaces.finder import install
from rn_robot_fr3.limits import ACCELERATION_RAD_S2, ARM_JOINTS, VELOCITY_RAD_S
from rn_robot_fr3.profile import profile

install()
from moveit_msgs.action import ExecuteTrajectory, MoveGroup  # noqa: E402  (known from here on)
from moveit_msgs.msg import (  # noqa: E402
    Constraints,
    MotionPlanRequest,
    MoveItErrorCodes,
    RobotTrajectory,
)

F64 = NDArray[np.float64]
GROUP = "fr3_arm"
PERIOD_S, ROW_S, HOLD_S = 0.02, 0.1, 0.1
SILENCE_S, FIRST_S = 1.0, 15.0
"""Age at which joint states are stale, and time for the arm to be discovered."""
START_TOLERANCE_RAD, GOAL_TOLERANCE_RAD = 0.01, 0.02
SLACK, SLACK_S = 1.5, 2.0
"""Factor and margin for the duration of an execution."""


class Failure(Exception):
    """A failure of MoveIt, with the name of an error code."""

    def __init__(self, code: str, text: str) -> None:
        super().__init__(text)
        self.code, self.text = code, text


@dataclass(kw_only=True, slots=True)
class Run:
    """One running goal; times are monotonic [s].

    Attributes:
        target: final joint positions, float64 (7,); None until the execution starts.
        done: gets the name of an error code and a sentence.
    """

    handle: ServerGoalHandle
    begun_s: float
    done: Future
    target: F64 | None = None
    executed_s: float = 0.0
    lasts_s: float = 0.0
    result: MoveGroup.Result | ExecuteTrajectory.Result | None = None


def line(start: F64, goal: F64, velocity: float, acceleration: float) -> JointTrajectory:
    """Plan a straight line from rest to rest, cubic in time, at shares of the joints' limits."""
    way = np.abs(goal - start)
    at_most_v = np.array(VELOCITY_RAD_S) * velocity
    at_most_a = np.array(ACCELERATION_RAD_S2) * acceleration
    # for a cubic the peak velocity is 1.5 distance / time, the peak acceleration 6 distance /
    # time^2
    lasts_s = max(ROW_S, (1.5 * way / at_most_v).max(), math.sqrt((6.0 * way / at_most_a).max()))
    made = JointTrajectory(joint_names=list(ARM_JOINTS))
    rows = math.ceil(lasts_s / ROW_S)
    for row in range(rows + 1):
        share = row / rows
        place = start + (goal - start) * (3.0 * share**2 - 2.0 * share**3)
        speed = (goal - start) * (6.0 * share - 6.0 * share**2) / lasts_s
        at_s = lasts_s * share
        made.points.append(
            JointTrajectoryPoint(
                positions=place.tolist(),
                velocities=speed.tolist(),
                time_from_start=to_duration(at_s),
            )
        )
    return made


class MoveGroupStandIn(Node):
    """Two action servers, one arm."""

    def __init__(self, options: argparse.Namespace) -> None:
        """Offer the actions; the arm moves on a goal."""
        super().__init__("move_group", namespace=options.namespace)
        self._options = options
        self._profile = profile()
        self._arm = ArmKinematics(UrdfControllerOptions(), self._profile, self._profile.each_arm[0])
        self._measured: tuple[float, F64] | None = None
        self._run: Run | None = None
        self._command = self.create_publisher(JointTrajectory, "joint_trajectory", 1)
        self.create_subscription(JointState, "joint_states", self._on_joints, 1)
        self._servers = [
            ActionServer(
                self,
                kind,
                name,
                self._execute,
                goal_callback=self._judge,
                cancel_callback=lambda handle: CancelResponse.ACCEPT,
            )
            for kind, name in (
                (MoveGroup, "move_action"),
                (ExecuteTrajectory, "execute_trajectory"),
            )
        ]
        self.create_timer(PERIOD_S, self._cycle)

    def _on_joints(self, message: JointState) -> None:
        found = dict(zip(message.name, message.position, strict=True))
        if set(ARM_JOINTS) <= found.keys():
            self._measured = time.monotonic(), np.array([found[name] for name in ARM_JOINTS])

    def _judge(self, goal: MoveGroup.Goal | ExecuteTrajectory.Goal) -> GoalResponse:
        return GoalResponse.ACCEPT if self._run is None else GoalResponse.REJECT

    async def _execute(
        self, handle: ServerGoalHandle
    ) -> MoveGroup.Result | ExecuteTrajectory.Result:
        is_planned = isinstance(handle.request, MoveGroup.Goal)
        result = MoveGroup.Result() if is_planned else ExecuteTrajectory.Result()
        run = Run(
            handle=handle,
            begun_s=time.monotonic(),
            done=Future(executor=self.executor),
            result=result,
        )
        self._run = run
        if is_planned:
            self._tell(run, "PLANNING")
        code, text = await run.done
        result.error_code.val = getattr(MoveItErrorCodes, code)
        result.error_code.message = text
        result.error_code.source = "moveit_standin"
        if code == "SUCCESS":
            handle.succeed()
        elif code == "PREEMPTED":
            handle.canceled()
        else:
            self.get_logger().error(text)
            handle.abort()
        return result

    def _tell(self, run: Run, state: str) -> None:
        kind = MoveGroup if isinstance(run.handle.request, MoveGroup.Goal) else ExecuteTrajectory
        run.handle.publish_feedback(kind.Feedback(state=state))

    def _finish(self, code: str, text: str = "") -> None:
        run, self._run = self._run, None
        assert run is not None
        run.done.set_result((code, text))

    def _cycle(self) -> None:
        """Plan a new goal, or supervise the running one."""
        run, now_s = self._run, time.monotonic()
        if run is None:
            return
        try:
            if run.handle.is_cancel_requested:
                self._hold()
                raise Failure("PREEMPTED", "It was cancelled.")
            here = self._here(run, now_s)
            if here is None or now_s - run.begun_s < self._options.delay:
                return
            if run.target is None:
                self._begin(run, here, now_s)
            else:
                self._watch(run, here, now_s)
        except Failure as failure:
            self._finish(failure.code, failure.text)

    def _here(self, run: Run, now_s: float) -> F64 | None:
        """Measured joint positions; None while they may still arrive."""
        heard_s, here = self._measured or (run.begun_s, None)
        bound_s = FIRST_S if here is None else SILENCE_S
        if now_s - max(heard_s, run.begun_s) > bound_s:
            self._hold()
            raise Failure("ROBOT_STATE_STALE", "The state of the robot is not known.")
        return here if here is not None and now_s - heard_s <= SILENCE_S else None

    def _begin(self, run: Run, here: F64, now_s: float) -> None:
        goal, result = run.handle.request, run.result
        if isinstance(goal, MoveGroup.Goal):
            request = goal.request
            start = here
            if goal.planning_options.plan_only:
                start = _start_of(request, here)
            trajectory = self._plan(request, start)
            assert isinstance(result, MoveGroup.Result)
            result.planned_trajectory = RobotTrajectory(joint_trajectory=trajectory)
            result.planning_time = now_s - run.begun_s
            if goal.planning_options.plan_only:
                raise Failure("SUCCESS", "")
        else:
            trajectory = goal.trajectory.joint_trajectory
        self._check(trajectory, here)
        later = [p for p in trajectory.points if _seconds(p.time_from_start) > 0.0]
        if not later:
            raise Failure("SUCCESS", "")
        # without the first row, because the driver accepts no row for the current position
        self._command.publish(JointTrajectory(joint_names=trajectory.joint_names, points=later))
        self._tell(run, "MONITOR")
        order = [trajectory.joint_names.index(name) for name in ARM_JOINTS]
        run.target = np.array(trajectory.points[-1].positions)[order]
        run.executed_s = now_s
        run.lasts_s = _seconds(trajectory.points[-1].time_from_start)

    def _plan(self, request: MotionPlanRequest, start: F64) -> JointTrajectory:
        if request.group_name != GROUP:
            raise Failure(
                "INVALID_GROUP_NAME", f"There is no group {request.group_name!r}, only {GROUP!r}."
            )
        if not request.goal_constraints:
            raise Failure("INVALID_GOAL_CONSTRAINTS", "The goal has no constraints.")
        goal = self._target(request.goal_constraints[0], start)
        limits = self._arm.model
        if ((goal < limits.lower) | (goal > limits.upper)).any():
            raise Failure("GOAL_STATE_INVALID", "The goal is beyond the limits of a joint.")
        scaling = [
            factor if 0.0 < factor <= 1.0 else 1.0
            for factor in (
                request.max_velocity_scaling_factor,
                request.max_acceleration_scaling_factor,
            )
        ]
        return line(start, goal, *scaling)

    def _target(self, goal: Constraints, start: F64) -> F64:
        """Joint positions for the first of the constraints."""
        if goal.joint_constraints:
            target = start.copy()
            for joint in goal.joint_constraints:
                if joint.joint_name not in ARM_JOINTS:
                    raise Failure(
                        "INVALID_GOAL_CONSTRAINTS", f"There is no joint {joint.joint_name!r}."
                    )
                target[ARM_JOINTS.index(joint.joint_name)] = joint.position
            return target
        for part in (*goal.position_constraints, *goal.orientation_constraints):
            if part.link_name != self._profile.tcp_link:
                raise Failure("INVALID_LINK_NAME", f"There is no link {part.link_name!r}.")
            if part.header.frame_id != self._profile.base_link:
                raise Failure(
                    "FRAME_TRANSFORM_FAILURE", f"There is no frame {part.header.frame_id!r}."
                )
        if not goal.position_constraints:
            raise Failure("INVALID_GOAL_CONSTRAINTS", "The goal names no place.")
        centre = goal.position_constraints[0].constraint_region.primitive_poses[0].position
        turn = self._arm.solver.place(start).rotation
        for part in goal.orientation_constraints[:1]:
            q = part.orientation
            turn = pinocchio.Quaternion(q.w, q.x, q.y, q.z).normalized().matrix()
        pose = pinocchio.SE3(turn, np.array([centre.x, centre.y, centre.z]))
        found = self._arm.solver.solve(
            start, pose, tolerance_m=1e-4, tolerance_rad=1e-3, max_iterations=200
        )
        if found.residual_m > 1e-3 or found.residual_rad > 1e-2:
            raise Failure("NO_IK_SOLUTION", "No posture of the arm reaches the goal.")
        return found.position

    def _check(self, trajectory: JointTrajectory, here: F64) -> None:
        if sorted(trajectory.joint_names) != sorted(ARM_JOINTS) or not trajectory.points:
            raise Failure("CONTROL_FAILED", "No controller moves the joints of the trajectory.")
        order = [trajectory.joint_names.index(name) for name in ARM_JOINTS]
        first = np.array(trajectory.points[0].positions)[order]
        starts_now = _seconds(trajectory.points[0].time_from_start) == 0.0
        if starts_now and (np.abs(first - here) > START_TOLERANCE_RAD).any():
            raise Failure("CONTROL_FAILED", "The trajectory does not start where the arm is.")

    def _watch(self, run: Run, here: F64, now_s: float) -> None:
        assert run.target is not None
        since_s = now_s - run.executed_s
        if since_s >= run.lasts_s and (np.abs(here - run.target) < GOAL_TOLERANCE_RAD).all():
            raise Failure("SUCCESS", "")
        if since_s > SLACK * run.lasts_s + SLACK_S:
            self._hold()
            raise Failure("TIMED_OUT", "The controller is too slow.")
        self._tell(run, "MONITOR")

    def _hold(self) -> None:
        """Hold the arm at its measured position, unless it was not commanded."""
        if self._run is None or self._run.target is None or self._measured is None:
            return
        point = JointTrajectoryPoint(
            positions=self._measured[1].tolist(), time_from_start=to_duration(HOLD_S)
        )
        self._command.publish(JointTrajectory(joint_names=list(ARM_JOINTS), points=[point]))


def _start_of(request: MotionPlanRequest, here: F64) -> F64:
    """Start of a plan that is not executed: the start state, completed by measured positions."""
    state, start = request.start_state.joint_state, here.copy()
    for name, position in zip(state.name, state.position, strict=True):
        if name not in ARM_JOINTS:
            raise Failure("INVALID_ROBOT_STATE", f"There is no joint {name!r}.")
        start[ARM_JOINTS.index(name)] = position
    return start


def _seconds(duration: Duration) -> float:
    return float(duration.sec + duration.nanosec * 1e-9)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run until SIGINT or SIGTERM."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--namespace", default="", help="of the arm and of the actions")
    parser.add_argument("--delay", type=float, default=0.1, help="of planning [s]")
    options = parser.parse_args(arguments)
    run_node(lambda: MoveGroupStandIn(options), "move_action is offered")


if __name__ == "__main__":
    main()
