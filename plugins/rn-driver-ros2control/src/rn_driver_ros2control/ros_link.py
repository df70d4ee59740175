"""The controller over ROS 2: a separate node in this process, with its own executor thread."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Mapping

import rclpy
from control_msgs.action import FollowJointTrajectory, GripperCommand, ParallelGripperCommand
from control_msgs.msg import JointTolerance, JointTrajectoryControllerState
from rclpy.action import ActionClient
from rclpy.action.client import ClientGoalHandle
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from rn_driver_ros2control.link import (
    ControllerReport,
    End,
    GoalObserver,
    ListedController,
    MeasuredJoint,
    measured_joints,
)
from rn_driver_ros2control.manager import ManagerWatch
from rn_driver_ros2control.options import Ros2ControlOptions
from rn_driver_ros2control.sampling import seconds
from rn_driver_ros2control.trajectory import to_duration
from roboneuron import InvalidInputError, NotReadyError, StateError

log = logging.getLogger(__name__)

_CANCELLED, _ABORTED = 5, 6
"""action_msgs/GoalStatus."""
_LOOK_S = 0.05
_CODES = {
    FollowJointTrajectory.Result.PATH_TOLERANCE_VIOLATED: End.PATH_TOLERANCE,
    FollowJointTrajectory.Result.GOAL_TOLERANCE_VIOLATED: End.GOAL_TOLERANCE,
}
_STATES = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Matches reliable and best-effort publishers; only the newest value is kept."""


class _TrajectoryGoal:
    """One FollowJointTrajectory goal in progress.

    Attributes:
        deadline_s: monotonic time until which it has to be answered.
        result_s: until which it has to end; infinite if the controller may wait for ever.
    """

    def __init__(self, deadline_s: float, result_s: float) -> None:
        self.deadline_s = deadline_s
        self.result_s = result_s
        self.answered = threading.Event()
        self.accepted = False
        self.handle: ClientGoalHandle | None = None


class RosControllerLink:
    """Implements `ControllerLink`. It has its own ROS context, so that it can be opened in any
    process.
    """

    def __init__(self, options: Ros2ControlOptions, joints: tuple[str, ...]) -> None:
        """Store the options; `joints` are the arm's, for which tolerances are requested."""
        self._options = options
        self._arm = joints
        self._lock = threading.Lock()
        self._measured: dict[str, MeasuredJoint] = {}
        self._refused = ""
        self._report: ControllerReport | None = None
        self._goals: dict[int, _TrajectoryGoal] = {}
        self._gripper_note = "no command yet"
        self._gripper_goals = 0
        self._gripper_due_s = math.inf  # when the newest goal has to be answered
        self._observer: GoalObserver | None = None
        self._manager = ManagerWatch(options)
        self._clients: list[ActionClient] = []
        self._gripper: ActionClient = None  # until open, or without one
        self._context: rclpy.Context | None = None
        self._thread: threading.Thread | None = None

    def open(self, observer: GoalObserver) -> None:
        """See `ControllerLink.open`."""
        self._observer = observer
        self._context = rclpy.Context()
        rclpy.init(context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        name = f"roboneuron_{self._options.controller.rpartition('/')[2]}"
        self._executor = SingleThreadedExecutor(context=self._context)
        node = self._node = Node(
            name, context=self._context, enable_rosout=False, start_parameter_services=False
        )
        topics = {
            self._options.joint_states,
            self._options.gripper_joint_states or self._options.joint_states,
        }
        for topic in sorted(topics):
            node.create_subscription(JointState, topic, self._on_joints, _STATES)
        self._join_controller(node)
        self._manager.join(node)
        if self._options.gripper != "none":
            kind = (
                GripperCommand
                if self._options.gripper == "gripper-command"
                else ParallelGripperCommand
            )
            self._gripper = ActionClient(node, kind, self._options.gripper_action)
            self._clients.append(self._gripper)
        node.create_timer(_LOOK_S, self._look_for_unanswered)
        self._executor.add_node(node)
        self._thread = threading.Thread(target=self._spin, name="ros2-control", daemon=True)
        self._thread.start()
        self._wait(
            lambda: bool(self._measured),
            f"nobody publishes joint states on {self._options.joint_states}",
        )
        self._wait(
            self.is_present,
            f"there is no controller {self._options.controller} (or not configured)",
        )
        if self._gripper is not None:
            self._wait(
                self._gripper.server_is_ready,
                f"there is no gripper action {self._options.gripper_action}",
            )

    def _join_controller(self, node: Node) -> None:
        """Create what the type of controller needs."""
        if self._options.watch_controller:
            topic = f"{self._options.controller}/controller_state"
            node.create_subscription(
                JointTrajectoryControllerState, topic, self._on_report, _STATES
            )
        self._publisher = node.create_publisher(
            JointTrajectory, f"{self._options.controller}/joint_trajectory", 1
        )
        action = f"{self._options.controller}/follow_joint_trajectory"
        self._actions = ActionClient(node, FollowJointTrajectory, action)
        self._clients.append(self._actions)

    def _spin(self) -> None:
        """Execute callbacks until `close`; one that raises does not end the others."""
        while (context := self._context) is not None and context.ok():
            try:
                self._executor.spin_once()
            except ExternalShutdownException:
                return
            except Exception:  # of a callback, or of a message that cannot be taken
                if self._context is not None:
                    log.exception("A callback of ros2_control failed.")
                    time.sleep(_LOOK_S)

    def _wait(self, condition: Callable[[], bool], absent: str) -> None:
        deadline_s = time.monotonic() + self._options.connect_timeout_s
        while not condition():
            if time.monotonic() > deadline_s:
                raise NotReadyError(
                    f"After {self._options.connect_timeout_s:g} s {absent}.",
                    hint="Start ros2_control and its controllers (`ros2 control "
                    "list_controllers`), compare the names "
                    "with the options, and ROS_DOMAIN_ID and the discovery range on both sides.",
                )
            time.sleep(_LOOK_S)

    def joints(self) -> Mapping[str, MeasuredJoint]:
        """See `ControllerLink.joints`."""
        with self._lock:
            return dict(self._measured)

    def report(self) -> ControllerReport | None:
        """See `ControllerLink.report`."""
        return self._report

    def listed(self) -> ListedController | None:
        """See `ControllerLink.listed`."""
        return self._manager.listed

    def is_present(self) -> bool:
        """See `ControllerLink.is_present`."""
        if self._options.mode == "action":
            return bool(self._actions.server_is_ready())
        return int(self._publisher.get_subscription_count()) > 0

    def publish(self, trajectory: JointTrajectory) -> None:
        """See `ControllerLink.publish`."""
        with self._lock:
            if self._context is None or not self._context.ok():
                raise StateError("The connection to ros2_control is closed.")
            self._publisher.publish(trajectory)

    def send_goal(self, goal: int, trajectory: JointTrajectory) -> None:
        """See `ControllerLink.send_goal`."""
        message = FollowJointTrajectory.Goal(trajectory=trajectory)
        if self._options.path_tolerance:
            message.path_tolerance = self._tolerances(trajectory, self._options.path_tolerance)
        if self._options.goal_tolerance:
            message.goal_tolerance = self._tolerances(trajectory, self._options.goal_tolerance)
        message.goal_time_tolerance = to_duration(self._options.goal_time_tolerance_s)
        now_s, late_s = time.monotonic(), self._options.goal_time_tolerance_s
        lasts_s = seconds(trajectory.points[-1]) + late_s + 2 * self._options.goal_timeout_s
        state = _TrajectoryGoal(
            now_s + self._options.goal_timeout_s, now_s + lasts_s if late_s else math.inf
        )
        with self._lock:
            if self._context is None or not self._context.ok():
                raise StateError("The connection to ros2_control is closed.")
            self._goals[goal] = state

        def send() -> None:
            if goal in self._goals:  # absent if it has ended without an answer
                future = self._actions.send_goal_async(message)
                future.add_done_callback(lambda done: self._on_answer(goal, state, done.result()))

        self._on_executor(send, lambda text: self._end(goal, End.UNANSWERED, text))

    def _on_executor(self, send: Callable[[], None], on_error: Callable[[str], None]) -> None:
        """Send a goal from the executor's thread, without waiting for it: rclpy registers a request
        after sending it, so on another thread a quick answer may arrive in between and be lost.
        """

        def task() -> None:
            try:
                send()
            except Exception as error:  # raised further it would end the thread
                on_error(f"the goal could not be sent ({error})")

        self._executor.create_task(task)

    def _tolerances(self, trajectory: JointTrajectory, bound: float) -> list[JointTolerance]:
        return [JointTolerance(name=name, position=float(bound)) for name in trajectory.joint_names]

    def wait_accepted(self, goal: int, timeout_s: float) -> bool:
        """See `ControllerLink.wait_accepted`."""
        state = self._goals.get(goal)
        return state is None or (state.answered.wait(timeout_s) and state.accepted)

    def cancel_goals(self) -> None:
        """See `ControllerLink.cancel_goals`."""
        with self._lock:
            handles = [state.handle for state in self._goals.values() if state.handle is not None]
            for handle in handles if self._context is not None and self._context.ok() else ():
                handle.cancel_goal_async()

    def move_gripper(self, position: float) -> None:
        """See `ControllerLink.move_gripper`."""
        message = self._gripper_goal(position)
        with self._lock:
            if self._gripper is None or self._context is None or not self._context.ok():
                return
            self._gripper_goals += 1
            number = self._gripper_goals
            self._gripper_note = "moving"
            self._gripper_due_s = time.monotonic() + self._options.goal_timeout_s

        def send() -> None:
            if number == self._gripper_goals:
                future = self._gripper.send_goal_async(message)
                future.add_done_callback(
                    lambda done: self._on_gripper_answer(number, done.result())
                )

        self._on_executor(send, lambda text: self._note_gripper(number, text))

    def _note_gripper(self, number: int, text: str) -> None:
        if number == self._gripper_goals:
            self._gripper_note = text

    def _gripper_goal(self, position: float) -> GripperCommand.Goal | ParallelGripperCommand.Goal:
        if self._options.gripper == "gripper-command":
            command = GripperCommand.Goal()
            command.command.position = float(position)
            command.command.max_effort = float(self._options.gripper_effort_n)
            return command
        parallel = ParallelGripperCommand.Goal()
        parallel.command.position = [float(position)]
        parallel.command.effort = [float(self._options.gripper_effort_n)]
        return parallel

    def gripper_note(self) -> str:
        """See `ControllerLink.gripper_note`."""
        return self._gripper_note

    def close(self) -> None:
        """See `ControllerLink.close`."""
        with self._lock:
            context, self._context = self._context, None
        if context is None:
            return
        self._executor.shutdown(timeout_sec=2.0)
        if self._thread is not None:
            self._thread.join(2.0)
        for client in self._clients:
            client.destroy()
        self._node.destroy_node()
        rclpy.try_shutdown(context=context)

    def _on_joints(self, message: JointState) -> None:
        try:
            joints = measured_joints(message, time.monotonic(), self._measured)
        except InvalidInputError as error:
            if str(error) != self._refused:
                self._refused = str(error)
                log.warning("A message of %s is left out: %s", self._options.joint_states, error)
            return
        with self._lock:
            self._measured |= joints

    def _on_report(self, message: JointTrajectoryControllerState) -> None:
        names = tuple(message.joint_names)
        positions, velocities = message.reference.positions, message.reference.velocities
        moving = velocities if len(velocities) == len(names) else [0.0] * len(names)
        self._report = ControllerReport(
            joints=names,
            reference={
                n: (float(p), float(v)) for n, p, v in zip(names, positions, moving, strict=False)
            },
            error={n: float(e) for n, e in zip(names, message.error.positions, strict=False)},
            speed_scaling=float(message.speed_scaling_factor),
            received_s=time.monotonic(),
        )

    def _on_answer(self, goal: int, state: _TrajectoryGoal, handle: ClientGoalHandle) -> None:
        if not handle.accepted:
            self._end(goal, End.REJECTED, "the controller rejected the goal; its log says why")
            return
        state.handle, state.accepted = handle, True
        state.answered.set()
        handle.get_result_async().add_done_callback(
            lambda done: self._on_result(goal, done.result())
        )

    def _on_result(
        self, goal: int, answer: FollowJointTrajectory.Impl.GetResultService.Response
    ) -> None:
        result: FollowJointTrajectory.Result = answer.result
        if answer.status == _CANCELLED:
            end = End.CANCELLED
        elif (
            answer.status == _ABORTED
            or result.error_code != FollowJointTrajectory.Result.SUCCESSFUL
        ):
            end = _CODES.get(result.error_code, End.ABORTED)
        else:
            end = End.SUCCEEDED
        self._end(goal, end, str(result.error_string))

    def _end(self, goal: int, end: End, text: str) -> None:
        with self._lock:
            state = self._goals.pop(goal, None)
        if state is not None and self._observer is not None:
            state.answered.set()
            self._observer.ended(goal, end, text)

    def _look_for_unanswered(self) -> None:
        now_s = time.monotonic()
        late = [
            n
            for n, state in list(self._goals.items())
            if not state.answered.is_set() and now_s > state.deadline_s
        ]
        for goal in late:
            self._end(
                goal,
                End.UNANSWERED,
                f"no answer to a goal within {self._options.goal_timeout_s:g} s",
            )
        lost = [n for n, state in list(self._goals.items()) if now_s > state.result_s]
        for goal in lost:
            self._end(goal, End.LOST, "no result after its end and the goal time tolerance")
        if now_s > self._gripper_due_s:
            self._gripper_due_s = math.inf
            self._gripper_note = "the gripper does not answer"

    def _on_gripper_answer(self, number: int, handle: ClientGoalHandle) -> None:
        if number == self._gripper_goals:
            self._gripper_due_s = math.inf
        if not handle.accepted:
            self._note_gripper(number, "rejected by the gripper")
            return
        self._note_gripper(number, "moving")
        handle.get_result_async().add_done_callback(
            lambda done: self._on_gripper_result(number, done.result())
        )

    def _on_gripper_result(
        self, number: int, answer: GripperCommand.Impl.GetResultService.Response
    ) -> None:
        note = "reached"
        if answer.result.stalled and not answer.result.reached_goal:
            note = "stalled: something is between the fingers, or they are blocked"
        elif answer.status == _ABORTED:
            note = "aborted by the gripper"
        self._note_gripper(number, note)
