"""`python -m rn_driver_ros2control.standin_node`: the stand-in as a ROS 2 node, with joint states
and a gripper.

Offers the interfaces of a real controller under its name (`joint_trajectory`,
`follow_joint_trajectory`, `controller_state`), `/joint_states`, a gripper action, and two services
for tests: `<controller>/activate` and `<controller>/block` (std_srvs/SetBool). It moves nothing.
"""

from __future__ import annotations

import argparse
import signal
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
import rclpy
from control_msgs.action import FollowJointTrajectory, GripperCommand, ParallelGripperCommand
from control_msgs.msg import JointTrajectoryControllerState
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import SetBool
from trajectory_msgs.msg import JointTrajectory

from rn_driver_ros2control.standin import (
    INVALID_GOAL,
    SUCCESSFUL,
    StandInController,
    Tolerances,
    TrajectoryEnd,
)

GripperGoal: TypeAlias = GripperCommand.Goal | ParallelGripperCommand.Goal
GripperResult: TypeAlias = GripperCommand.Result | ParallelGripperCommand.Result
_GRIPPERS = {
    "gripper-command": GripperCommand,
    "parallel-gripper-command": ParallelGripperCommand,
}
"""Types of the gripper's action, by the driver's option `gripper`."""
_FINGER_M_S = 0.05
_CANCELLED = TrajectoryEnd(code=SUCCESSFUL, text="")


def _positions(goal: GripperGoal) -> list[float]:
    if isinstance(goal, GripperCommand.Goal):
        return [float(goal.command.position)]
    return [float(value) for value in goal.command.position]


class StandInNode(Node):  # type: ignore[misc]
    """One controller and one gripper joint."""

    def __init__(self, options: argparse.Namespace) -> None:
        """Create everything; the timer starts with the executor."""
        namespace, _, name = options.controller.rpartition("/")
        super().__init__(name, namespace=namespace or "/")
        joints = tuple(options.joints)
        start = np.array(options.start or [0.0] * len(joints))
        bounds = Tolerances(
            path=dict.fromkeys(joints, options.path_tolerance),
            goal=dict.fromkeys(joints, options.goal_tolerance),
            goal_time_s=options.goal_time,
        )
        self.controller = StandInController(
            joints,
            start,
            tolerances=bounds,
            from_desired=options.from_desired,
            policy_frequency_hz=options.upsample,
        )
        self.controller.active = not options.inactive
        self._finger, self._finger_m, self._finger_goal_m = (
            options.gripper_joint,
            options.opening,
            options.opening,
        )
        self._object_m = options.object
        self._goal: ServerGoalHandle = None  # none until one is accepted
        self._done: Future | None = None
        self._finger_done: Future | None = None
        self._states = self.create_publisher(JointState, options.joint_states, 10)
        finger_states = options.gripper_joint_states or options.joint_states
        self._finger_states: Publisher = None  # None: fingers are among the arm's joints
        if finger_states != options.joint_states:
            self._finger_states = self.create_publisher(JointState, finger_states, 10)
        self._reports: Publisher = None  # a forward controller reports nothing
        self.create_service(SetBool, "~/activate", self._on_activate)
        self.create_service(SetBool, "~/block", self._on_block)
        self._refuses, self._loses = options.refuse_goals, options.lose_goals
        if options.type == "forward-position":
            self.declare_parameter("joints", list(joints))
            self.declare_parameter("interface_name", options.interface)
            self.create_subscription(Float64MultiArray, "~/commands", self._on_positions, 10)
        else:
            self._offer_trajectories()
        if self._finger:
            self._gripper = ActionServer(
                self,
                _GRIPPERS[options.gripper_type],
                options.gripper_action,
                self._execute_gripper,
                goal_callback=self._on_gripper_goal,
            )
        self._period_s = 1.0 / options.rate
        self.create_timer(self._period_s, self._cycle)

    def _offer_trajectories(self) -> None:
        self._reports = self.create_publisher(
            JointTrajectoryControllerState, "~/controller_state", 10
        )
        self.create_subscription(JointTrajectory, "~/joint_trajectory", self._on_trajectory, 10)
        self._server = ActionServer(
            self,
            FollowJointTrajectory,
            "~/follow_joint_trajectory",
            execute_callback=self._execute,
            goal_callback=self._on_goal,
            handle_accepted_callback=self._on_accepted,
            cancel_callback=self._on_cancel,
        )

    def _on_positions(self, message: Float64MultiArray) -> None:
        self.controller.forward(message.data)

    def _on_gripper_goal(self, goal: GripperGoal) -> GoalResponse:
        is_wrong = len(_positions(goal)) != 1
        if is_wrong:
            self.get_logger().error("Expected one position.")
        return GoalResponse.REJECT if is_wrong or self._refuses else GoalResponse.ACCEPT

    def _now_s(self) -> float:
        return float(self.get_clock().now().nanoseconds) / 1e9

    def _on_trajectory(self, message: JointTrajectory) -> None:
        message = self.controller.upsampled(message)
        if reason := self.controller.refusal(message, self._now_s()):
            self.get_logger().error(reason)
        elif self.controller.active:
            self.controller.take(message, self._now_s())  # an active goal continues unnotified

    def _on_goal(self, goal: FollowJointTrajectory.Goal) -> GoalResponse:
        reason = self.controller.refusal(goal.trajectory, self._now_s())
        if not self.controller.active:
            reason = "Can't accept new action goals. Controller is not running."
        if self._refuses:
            reason = "Goals are refused, as --refuse-goals says."
        if reason:
            self.get_logger().error(reason)
        return GoalResponse.REJECT if reason else GoalResponse.ACCEPT

    def _on_accepted(self, handle: ServerGoalHandle) -> None:
        self._finish(
            TrajectoryEnd(code=INVALID_GOAL, text="Current goal preempted by new incoming action.")
        )
        goal = handle.request
        bounds = self.controller.defaults.with_goal(
            {t.name: t.position for t in goal.path_tolerance},
            {t.name: t.position for t in goal.goal_tolerance},
            goal.goal_time_tolerance.sec + goal.goal_time_tolerance.nanosec * 1e-9,
        )
        self.controller.take(goal.trajectory, self._now_s(), bounds)
        self._goal, self._done = handle, Future(executor=self.executor)
        handle.execute()

    def _on_cancel(self, handle: ServerGoalHandle) -> CancelResponse:
        if handle is self._goal or (
            self._goal is not None and handle.goal_id == self._goal.goal_id
        ):
            self.controller.hold()
        return CancelResponse.ACCEPT

    async def _execute(self, handle: ServerGoalHandle) -> FollowJointTrajectory.Result:
        done = self._done
        assert done is not None
        verdict: TrajectoryEnd = await done
        if verdict is _CANCELLED:
            handle.canceled()
        elif verdict.code == SUCCESSFUL:
            handle.succeed()
        else:
            handle.abort()
        return FollowJointTrajectory.Result(error_code=int(verdict.code), error_string=verdict.text)

    def _finish(self, verdict: TrajectoryEnd) -> None:
        """Send the result to the client of the active goal, if there is one."""
        done, self._goal, self._done = self._done, None, None
        if done is not None and not self._loses and not done.done():
            done.set_result(verdict)

    def _on_activate(
        self, request: SetBool.Request, response: SetBool.Response
    ) -> SetBool.Response:
        if not request.data:
            self._finish(
                TrajectoryEnd(
                    code=INVALID_GOAL, text="Current goal cancelled during deactivate transition."
                )
            )
        self.controller.hold()
        self.controller.active = request.data
        response.success = True
        return response

    def _on_block(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self.controller.blocked = request.data
        response.success = True
        return response

    async def _execute_gripper(self, handle: ServerGoalHandle) -> GripperResult:
        if self._finger_done is not None and not self._finger_done.done():
            self._finger_done.set_result(False)  # preempted
        self._finger_goal_m = _positions(handle.request)[0]
        self._finger_done = Future(executor=self.executor)
        reached = await self._finger_done
        handle.succeed() if reached is not False else handle.abort()
        stalled = abs(self._finger_m - self._finger_goal_m) > 1e-4
        if isinstance(handle.request, GripperCommand.Goal):
            return GripperCommand.Result(
                position=float(self._finger_m), stalled=stalled, reached_goal=not stalled
            )
        state = JointState(name=[self._finger], position=[float(self._finger_m)])
        return ParallelGripperCommand.Result(state=state, stalled=stalled, reached_goal=not stalled)

    def _move_finger(self) -> None:
        least_m = (
            max(self._finger_goal_m, self._object_m)
            if self._finger_goal_m < self._finger_m
            else -np.inf
        )
        goal_m = max(self._finger_goal_m, least_m)
        step_m = _FINGER_M_S * self._period_s
        self._finger_m += float(np.clip(goal_m - self._finger_m, -step_m, step_m))
        if (
            abs(goal_m - self._finger_m) < 1e-6
            and self._finger_done is not None
            and not self._finger_done.done()
        ):
            self._finger_done.set_result(True)

    def _add_finger(self, state: JointState) -> None:
        """Add the finger to `state`, or publish it on its own topic."""
        own = state if self._finger_states is None else JointState(header=state.header)
        own.name = [*own.name, self._finger]
        own.position = [*own.position, float(self._finger_m)]
        own.velocity = [*own.velocity, 0.0]
        if self._finger_states is not None:
            self._finger_states.publish(own)

    def _feedback(self) -> FollowJointTrajectory.Feedback:
        """Desired and actual joint positions, sent in each cycle."""
        controller = self.controller
        feedback = FollowJointTrajectory.Feedback(joint_names=list(controller.joints))
        feedback.header.stamp = self.get_clock().now().to_msg()
        feedback.desired.positions = controller.reference.tolist()
        feedback.actual.positions = controller.measured.tolist()
        feedback.error.positions = (controller.reference - controller.measured).tolist()
        return feedback

    def _cycle(self) -> None:
        controller = self.controller
        verdict = controller.update(self._now_s())
        if self._goal is not None and self._goal.is_cancel_requested:
            self._finish(_CANCELLED)
        elif verdict is not None:
            self._finish(verdict)
        if self._goal is not None:
            self._goal.publish_feedback(self._feedback())
        self._move_finger()
        stamp = self.get_clock().now().to_msg()
        names, position, velocity = (
            list(controller.joints),
            controller.measured.tolist(),
            controller.measured_velocity,
        )
        state = JointState(name=names, position=position, velocity=velocity.tolist())
        state.header.stamp = stamp
        if self._finger:
            self._add_finger(state)
        self._states.publish(state)
        if not controller.active or self._reports is None:
            return
        report = JointTrajectoryControllerState(joint_names=names, speed_scaling_factor=1.0)
        report.header.stamp = stamp
        report.reference.positions = controller.reference.tolist()
        report.reference.velocities = controller.reference_velocity.tolist()
        report.feedback.positions = position
        report.error.positions = (controller.reference - controller.measured).tolist()
        self._reports.publish(report)


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """Options of the program."""
    parser = argparse.ArgumentParser(
        prog="python -m rn_driver_ros2control.standin_node", description=__doc__
    )
    parser.add_argument(
        "--controller", default="/joint_trajectory_controller", help="absolute name"
    )
    parser.add_argument("--joints", nargs="+", required=True, help="names of the joints it moves")
    parser.add_argument(
        "--start", nargs="+", type=float, help="their positions at the start; 0 each when left out"
    )
    parser.add_argument(
        "--type",
        choices=["joint-trajectory", "forward-position"],
        default="joint-trajectory",
        help="of the controller, as the driver's option controller_type",
    )
    parser.add_argument(
        "--interface", default="position", help="that a forward controller says it forwards"
    )
    parser.add_argument("--joint-states", default="/joint_states")
    parser.add_argument(
        "--gripper-joint", default="", help="name of a gripper joint; none when left out"
    )
    parser.add_argument("--gripper-type", choices=list(_GRIPPERS), default="gripper-command")
    parser.add_argument("--refuse-goals", action="store_true", help="reject every goal")
    parser.add_argument(
        "--lose-goals", action="store_true", help="accept goals and never send a result"
    )
    parser.add_argument("--gripper-action", default="/gripper_controller/gripper_cmd")
    parser.add_argument(
        "--gripper-joint-states", default="", help="topic of that joint; the arm's when left out"
    )
    parser.add_argument(
        "--opening", type=float, default=0.04, help="position of the gripper joint at the start [m]"
    )
    parser.add_argument(
        "--object", type=float, default=0.0, help="where closing fingers meet something [m]"
    )
    parser.add_argument(
        "--path-tolerance", type=float, default=0.0, help="constraints.<joint>.trajectory"
    )
    parser.add_argument(
        "--goal-tolerance", type=float, default=0.0, help="constraints.<joint>.goal"
    )
    parser.add_argument("--goal-time", type=float, default=0.0, help="constraints.goal_time")
    parser.add_argument(
        "--from-desired", action="store_true", help="interpolate_from_desired_state"
    )
    parser.add_argument(
        "--upsample",
        type=float,
        default=0.0,
        metavar="HZ",
        help="positions_upsampling with this policy_frequency; 0: off",
    )
    parser.add_argument("--inactive", action="store_true", help="begin inactive")
    parser.add_argument("--rate", type=float, default=100.0, help="cycles per second")
    return parser.parse_args(arguments)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run until SIGINT or SIGTERM."""
    options = parse(arguments)
    rclpy.init(signal_handler_options=SignalHandlerOptions.ALL)
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    node = StandInNode(options)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
