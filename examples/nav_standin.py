"""A stand-in for nav2's bt_navigator that drives a base: the action `navigate_to_pose` over
`cmd_vel` and `odom`.

    roboneuron ros learn examples/ros      # once: the type NavigateToPose
    python examples/nav_standin.py --namespace diffdrive

It drives straight to the goal on an empty map whose frame is that of the odometry, and follows the
rules of the action: an inactive navigator rejects goals, a new goal preempts the running one,
cancelling one stops the base; a frame that cannot be transformed, a missing behaviour tree, an
unreachable place and a base that does not move lead to an abort with the error code of the
definition, the latter two after recoveries. Source: the definition of
nav2_msgs/action/NavigateToPose (ros-navigation/navigation2 at 06ac5d9) and nav2's documentation.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

from geometry_msgs.msg import PoseStamped, Twist
from nav_msgs.msg import Odometry
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node
from rclpy.task import Future
from standin_node import run_node, to_duration

from rn_interfaces.finder import install

install()
from nav2_msgs.action import NavigateToPose  # noqa: E402  (known from here on)

MAP, ODOM = "map", "odom"
PERIOD_S, TELL_S = 0.05, 0.1
SPEED_M_S, TURN_RAD_S = 0.4, 1.0
THERE_M, THERE_RAD = 0.03, 0.05
TURN_FIRST_RAD = 0.3
"""Heading error above which it turns on the spot."""
SILENCE_S, FIRST_S = 1.0, 15.0
"""Age at which odometry is stale, and time for the base to be discovered."""
MOST_RECOVERIES = 2


@dataclass(frozen=True, kw_only=True, slots=True)
class Planar:
    """A pose on the ground [m, rad]."""

    x_m: float
    y_m: float
    yaw_rad: float


def to_planar(message: PoseStamped | Odometry) -> Planar:
    """Planar pose of a message."""
    pose = message.pose if isinstance(message, PoseStamped) else message.pose.pose
    q = pose.orientation
    yaw_rad = math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z))
    return Planar(x_m=pose.position.x, y_m=pose.position.y, yaw_rad=yaw_rad)


def wrapped(angle_rad: float) -> float:
    """The same angle within -pi .. pi."""
    return math.remainder(angle_rad, 2 * math.pi)


def has_moved(before: Planar, now: Planar) -> bool:
    """True if the base has driven or turned more than its odometry's noise."""
    way_m = math.dist((before.x_m, before.y_m), (now.x_m, now.y_m))
    return way_m > 0.02 or abs(wrapped(now.yaw_rad - before.yaw_rad)) > 0.05


def has_stopped(speed: tuple[float, float]) -> bool:
    """True if the base neither drives [m/s] nor turns [rad/s]."""
    return abs(speed[0]) < 0.01 and abs(speed[1]) < 0.02


def steer(here: Planar, goal: Planar) -> tuple[float, float] | None:
    """Speed [m/s] and turning rate [rad/s] towards a goal; None at the goal."""
    dx, dy = goal.x_m - here.x_m, goal.y_m - here.y_m
    distance_m = math.hypot(dx, dy)
    if distance_m > THERE_M:
        error_rad = wrapped(math.atan2(dy, dx) - here.yaw_rad)
        speed = min(SPEED_M_S, distance_m) if abs(error_rad) < TURN_FIRST_RAD else 0.0
    else:
        error_rad, speed = wrapped(goal.yaw_rad - here.yaw_rad), 0.0
        if abs(error_rad) < THERE_RAD:
            return None
    return speed, max(-TURN_RAD_S, min(TURN_RAD_S, 1.5 * error_rad))


@dataclass(kw_only=True, slots=True)
class Run:
    """One running goal; times are monotonic [s].

    Attributes:
        last: pose of the base at its last motion.
        done: gets the error code and a sentence.
    """

    handle: ServerGoalHandle
    goal: Planar
    begun_s: float
    moved_s: float
    done: Future
    told_s: float = 0.0
    recoveries: int = 0
    last: Planar | None = None


class Navigator(Node):
    """One action server, one base."""

    def __init__(self, options: argparse.Namespace) -> None:
        """Offer the action; the base drives on a goal."""
        super().__init__("bt_navigator", namespace=options.namespace)
        self._options = options
        self._odometry: tuple[float, Planar] | None = None
        self._speed = 0.0, 0.0
        self._run: Run | None = None
        self._velocity = self.create_publisher(Twist, "cmd_vel", 1)
        self.create_subscription(Odometry, "odom", self._on_odometry, 1)
        self._server = ActionServer(
            self,
            NavigateToPose,
            "navigate_to_pose",
            self._execute,
            goal_callback=self._judge,
            cancel_callback=lambda handle: CancelResponse.ACCEPT,
        )
        self.create_timer(PERIOD_S, self._cycle)

    def _on_odometry(self, message: Odometry) -> None:
        twist = message.twist.twist
        self._speed = twist.linear.x, twist.angular.z
        self._odometry = (time.monotonic(), to_planar(message))

    def _judge(self, goal: NavigateToPose.Goal) -> GoalResponse:
        return GoalResponse.REJECT if self._options.inactive else GoalResponse.ACCEPT

    async def _execute(self, handle: ServerGoalHandle) -> NavigateToPose.Result:
        now_s = time.monotonic()
        run = Run(
            handle=handle,
            goal=to_planar(handle.request.pose),
            begun_s=now_s,
            moved_s=now_s,
            done=Future(executor=self.executor),
        )
        self._finish(NavigateToPose.Result.UNKNOWN, "A newer goal has preempted this one.")
        self._run = run
        self._check(handle.request)
        code, text = await run.done
        if handle.is_cancel_requested:
            handle.canceled()
        elif code == NavigateToPose.Result.NONE:
            handle.succeed()
        else:
            self.get_logger().error(text)
            handle.abort()
        return NavigateToPose.Result(error_code=code, error_msg=text)

    def _finish(self, code: int, text: str = "") -> None:
        """End the running goal, if any, with the base at rest."""
        run, self._run = self._run, None
        if run is not None:
            self._velocity.publish(Twist())
            run.done.set_result((code, text))

    def _check(self, request: NavigateToPose.Goal) -> None:
        """End a goal that is impossible from the start."""
        codes, frame_id = NavigateToPose.Result, request.pose.header.frame_id
        if request.behavior_tree:
            self._finish(
                codes.FAILED_TO_LOAD_BEHAVIOR_TREE,
                f"Behavior tree {request.behavior_tree!r} cannot be loaded.",
            )
        elif frame_id not in (MAP, ODOM):
            self._finish(
                codes.TF_ERROR, f"A goal in frame {frame_id!r} cannot be transformed to {MAP}."
            )

    def _cycle(self) -> None:
        """Continue towards the running goal."""
        run, now_s, codes = self._run, time.monotonic(), NavigateToPose.Result
        if run is None:
            return
        if run.handle.is_cancel_requested:
            self._finish(codes.NONE)
            return
        heard_s, here = self._odometry or (run.begun_s, None)
        bound_s = FIRST_S if here is None else SILENCE_S
        if now_s - max(heard_s, run.begun_s) > bound_s:
            self._finish(codes.TF_ERROR, "There is no odometry: the pose of the base is not known.")
            return
        if here is None or now_s - heard_s > SILENCE_S:
            return  # not silent for long since the goal arrived
        if run.last is None or has_moved(run.last, here):
            run.last, run.moved_s = here, now_s
        if now_s - run.moved_s > self._options.patience:
            if run.recoveries == MOST_RECOVERIES:
                self._finish(codes.UNKNOWN, "The base makes no progress towards the goal.")
                return
            run.recoveries, run.moved_s = run.recoveries + 1, now_s
        velocity = steer(here, run.goal)
        if velocity is None and has_stopped(self._speed):
            self._finish(codes.NONE)
            return
        if velocity is None or self._is_blocked(run.goal):
            # it comes to rest and is checked again; or there is no path, only a recovery
            velocity = 0.0, 0.0
        twist = Twist()
        twist.linear.x, twist.angular.z = velocity
        self._velocity.publish(twist)
        if now_s - run.told_s > TELL_S:
            run.told_s = now_s
            self._tell(run, here, now_s)

    def _is_blocked(self, goal: Planar) -> bool:
        """True if the goal is in the blocked box."""
        if self._options.blocked is None:
            return False
        x0, y0, x1, y1 = self._options.blocked
        return bool(x0 <= goal.x_m <= x1 and y0 <= goal.y_m <= y1)

    def _tell(self, run: Run, here: Planar, now_s: float) -> None:
        feedback = NavigateToPose.Feedback()
        feedback.current_pose.header.frame_id = MAP
        feedback.current_pose.header.stamp = self.get_clock().now().to_msg()
        pose = feedback.current_pose.pose
        pose.position.x, pose.position.y = here.x_m, here.y_m
        pose.orientation.z = math.sin(here.yaw_rad / 2)
        pose.orientation.w = math.cos(here.yaw_rad / 2)
        distance_m = math.dist((here.x_m, here.y_m), (run.goal.x_m, run.goal.y_m))
        feedback.distance_remaining = distance_m
        feedback.number_of_recoveries = run.recoveries
        feedback.navigation_time = to_duration(now_s - run.begun_s)
        feedback.estimated_time_remaining = to_duration(distance_m / SPEED_M_S)
        run.handle.publish_feedback(feedback)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run until SIGINT or SIGTERM."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--namespace", default="", help="of the base: cmd_vel, odom, the action")
    parser.add_argument("--inactive", action="store_true", help="reject every goal")
    parser.add_argument(
        "--blocked",
        nargs=4,
        type=float,
        metavar=("X0", "Y0", "X1", "Y1"),
        help="no path leads into this box [m]",
    )
    parser.add_argument(
        "--patience", type=float, default=3.0, help="without progress for so long it recovers [s]"
    )
    options = parser.parse_args(arguments)
    run_node(lambda: Navigator(options), "navigate_to_pose is offered")


if __name__ == "__main__":
    main()
