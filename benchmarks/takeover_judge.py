"""A ROS 2 node that observes an arm under teleoperation, and the checks of what it recorded;
independent of the page.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from command_judge import SentCommand
from numpy.typing import NDArray
from touched_things import touched

from rn_robot_fr3.cell import FR3
from rn_simulation.scene_state import TOPIC, SceneState, from_message
from rn_standard.teleoperation.rows import Acting
from roboneuron import JointLimits

F64 = NDArray[np.float64]
SPACING_S = 0.02
"""Minimum spacing of joint states that are differenced: closer stamps turn small errors into large
differences.
"""
WINDOW_S = 0.4
"""Length of a span around a hand-over, and of the spans under the policy alone that it is compared
with [s].
"""
STILL_RAD_S = 0.01
TICK_S = 0.005
JOINTS_S = 0.02
"""Longest period of measured joint states [s]."""
HELD_UP_S = 0.03
"""A delay of the machine above this falsifies the trial: such trials are counted separately [s]."""
REST_S = 0.2
_SCENES = 600
"""Of the newest scenes, at 60 in a second: longer than a page is watched."""
WAYS = ("closed", "silent", "killed", "released")
"""How the page is lost."""
ROUNDING = 1.02
"""Share of a limit. The acceleration is judged of commands only: an arm whose commands keep it is
measured at up to twice of it under the undisturbed policy, as stamps are late by milliseconds.
"""
BORDER_S = 0.05
"""Longest time from sending an action until control reports that it acts [s]."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Motion:
    """Largest values over all joints in a span.

    Attributes:
        step_rad_s: change of velocity within 20 ms.
        acceleration: as a share of the joint's limit.
        jerk_rad_s3: jerk: measured velocities differenced twice over 20 ms.
        velocity: as a share of the joint's limit.
        outside_rad: distance beyond a position limit.
    """

    step_rad_s: float
    acceleration: float
    jerk_rad_s3: float
    velocity: float
    outside_rad: float


class Onlooker:
    """Records joint states, acting reports and actions; times are ns since 1970. Its lists may be
    read from any thread.
    """

    def __init__(self, robot: str, limits: JointLimits, stack: ExitStack) -> None:
        self._limits = limits
        self.joints: list[tuple[int, F64, F64]] = []
        self.acting: list[tuple[int, Acting]] = []
        self.actions: list[int] = []
        self.commands: list[SentCommand] = []
        self.late: list[tuple[int, float]] = []
        self.scenes: deque[SceneState] = deque(maxlen=_SCENES)
        self._watch(robot, stack)
        ended = threading.Event()
        stack.callback(ended.set)
        threading.Thread(target=self._tick, args=(ended,), daemon=True).start()

    def moves(self, since_ns: int) -> bool:
        """Whether a joint has moved since `since_ns`."""
        return any(
            np.abs(v).max() > STILL_RAD_S for at, _, v in self.joints[-400:] if at > since_ns
        )

    def motion(self, begin_ns: int, end_ns: int) -> Motion | None:
        """Largest values within a span; None when it has too few joint states."""
        rows = self.joints[self._first(begin_ns) :]
        apart: list[tuple[int, F64, F64]] = []
        for row in rows:
            if row[0] > end_ns:
                break
            if not apart or row[0] - apart[-1][0] >= SPACING_S * 1e9:
                apart.append(row)
        if len(apart) < 4:
            return None
        times = np.array([row[0] for row in apart], dtype=np.float64) / 1e9
        positions, velocities = (np.array([row[at] for row in apart]) for at in (1, 2))
        limits, spans = self._limits, np.diff(times)[:, None]
        steps = np.diff(velocities, axis=0)
        accelerations = steps / spans
        jerks = np.diff(accelerations, axis=0) / spans[1:]
        outside = np.maximum(limits.lower - positions, positions - limits.upper)
        return Motion(
            step_rad_s=float(np.abs(steps * np.minimum(1.0, SPACING_S / spans)).max()),
            acceleration=float((np.abs(accelerations) / limits.acceleration).max()),
            jerk_rad_s3=float(np.abs(jerks).max()),
            velocity=float((np.abs(velocities) / limits.velocity).max()),
            outside_rad=max(0.0, float(outside.max())),
        )

    def windows(self, begin_ns: int, end_ns: int) -> list[Motion]:
        """Motion in each consecutive window of a span."""
        length_ns = round(WINDOW_S * 1e9)
        starts = range(begin_ns, end_ns - length_ns, length_ns)
        found = [self.motion(start, start + length_ns) for start in starts]
        return [motion for motion in found if motion is not None]

    def rest_s(self, since_ns: int, until_ns: int) -> float:
        """Time from `since_ns` to the last motion of a joint before `until_ns` [s]."""
        rows = self.joints[self._first(since_ns) :]
        moving = [
            at for at, _, v in rows if at <= until_ns and float(np.abs(v).max()) > STILL_RAD_S
        ]
        return (moving[-1] - since_ns) / 1e9 if moving else 0.0

    def late_motion(self, since_ns: int, until_ns: int) -> dict[str, Any]:
        """What moved later than the arm should be at rest: the fastest joint (from 0), its speed
        [rad/s], its way [rad], the times of the first and the last such sample [s], and what the
        arm touched then, by the simulator's truth. Empty if nothing moved.
        """
        rows = [row for row in self.joints[self._first(since_ns) :] if row[0] <= until_ns]
        late = [row for row in rows if row[0] > since_ns + round(REST_S * 1e9)]
        moving = [row for row in late if float(np.abs(row[2]).max()) > STILL_RAD_S]
        if not moving:
            return {}
        fastest = max(moving, key=lambda row: float(np.abs(row[2]).max()))
        joint = int(np.abs(fastest[2]).argmax())
        places = [float(row[1][joint]) for row in late]
        first_ns, last_ns = moving[0][0], moving[-1][0]
        scenes = [one for one in list(self.scenes) if first_ns <= one.stamp_ns <= last_ns]
        return {
            "touched": sorted(touched(scenes)),
            "joint": joint,
            "speed_rad_s": float(np.abs(fastest[2]).max()),
            "way_rad": max(places) - min(places),
            "from_s": (first_ns - since_ns) / 1e9,
            "to_s": (last_ns - since_ns) / 1e9,
            "samples": len(moving),
        }

    def who(self, begin_ns: int, end_ns: int) -> set[str]:
        """Who acted within a span."""
        return {row.who for at, row in list(self.acting) if begin_ns <= at <= end_ns}

    def held_up_s(self, begin_ns: int, end_ns: int) -> float:
        """Longest delay within a span of this process's timer or of the robot's measurements [s]:
        delays by the machine, which affect all processes.
        """
        late = [late_s for at, late_s in list(self.late) if begin_ns <= at <= end_ns]
        stamps = [row[0] for row in self.joints[self._first(begin_ns) :] if row[0] <= end_ns]
        gaps = [(after - before) / 1e9 - JOINTS_S for before, after in pairwise(stamps)]
        return max([0.0, *late, *gaps])

    def went_on_s(self, back_ns: int) -> tuple[float, float] | None:
        """Time from the hand-back until control executes an action of the policy, and the age of
        that action then [s]; None while there is none. An action sent before the release does not
        count: control reports "policy" once at the release itself.
        """
        told = [at for at, row in list(self.acting) if at > back_ns and row.who == "policy"]
        for at in told[1:]:
            sent = [sent for sent in self.actions if sent <= at]
            if sent and sent[-1] >= told[0]:
                return (at - back_ns) / 1e9, (at - sent[-1]) / 1e9
        return None

    def _tick(self, ended: threading.Event) -> None:
        due_s = time.monotonic() + TICK_S
        while not ended.wait(max(0.0, due_s - time.monotonic())):
            late_s = time.monotonic() - due_s
            if late_s > TICK_S:
                self.late.append((time.time_ns(), late_s))
            due_s = time.monotonic() + TICK_S

    def _first(self, at_ns: int) -> int:
        low, high = 0, len(self.joints)
        while low < high:
            middle = (low + high) // 2
            if self.joints[middle][0] < at_ns:
                low = middle + 1
            else:
                high = middle
        return low

    def _watch(self, robot: str, stack: ExitStack) -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.qos import qos_profile_sensor_data
        from sensor_msgs.msg import JointState
        from std_msgs.msg import Float64MultiArray
        from trajectory_msgs.msg import JointTrajectory

        context = rclpy.Context()
        context.init()
        node = rclpy.create_node("onlooker", context=context)

        def joints(message: JointState) -> None:
            stamp = message.header.stamp
            at_ns = stamp.sec * 1_000_000_000 + stamp.nanosec
            if not self.joints or at_ns > self.joints[-1][0]:
                arm = len(self._limits.lower)
                position, velocity = message.position[:arm], message.velocity[:arm]
                self.joints.append((at_ns, np.array(position), np.array(velocity)))

        def acting(message: Float64MultiArray, info: dict[str, Any]) -> None:
            self.acting.append((int(info["source_timestamp"]), Acting.from_message(message)))

        def action(_: Float64MultiArray, info: dict[str, Any]) -> None:
            self.actions.append(int(info["source_timestamp"]))

        def scene(message: Float64MultiArray) -> None:
            self.scenes.append(from_message(message, {robot: len(FR3.joints)}))

        def command(message: JointTrajectory, info: dict[str, Any]) -> None:
            for point in message.points[:1]:
                after = point.time_from_start
                one = SentCommand(
                    at_ns=int(info["source_timestamp"]),
                    duration_s=after.sec + after.nanosec / 1e9,
                    target=np.array(point.positions[: len(self._limits.lower)]),
                )
                self.commands.append(one)

        for kind, topic, take in (
            (JointState, "joint_states", joints),
            (Float64MultiArray, "acting", acting),
            (Float64MultiArray, "action", action),
            (Float64MultiArray, TOPIC, scene),
        ):
            node.create_subscription(kind, f"/{robot}/{topic}", take, qos_profile_sensor_data)
        node.create_subscription(JointTrajectory, f"/{robot}/joint_trajectory", command, 100)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        threading.Thread(target=executor.spin, daemon=True).start()
        stack.callback(context.shutdown)
        stack.callback(executor.shutdown)


def faults_of(row: dict[str, Any]) -> list[str]:
    """Faults of one trial. Times and smoothness are judged only in trials that the machine did not
    delay.
    """
    whole, found = row["all"], list[str]()
    is_timed = row["held_up_s"] <= HELD_UP_S
    if whole is None:
        return ["nothing was measured"]
    if whole["outside_rad"] > 1e-3:
        found.append(f"{whole['outside_rad']:.4f} rad beyond a position limit")
    if is_timed and whole["velocity"] > ROUNDING:
        found.append(f"velocity {whole['velocity']:.2f} of the limit")
    found += faults_of_commands(row["sent"]["all"], row["unknown"])
    if row["part"] == "lost":
        # fingers that press a cube or the table slip after the last command
        if is_timed and row["rest_s"] > REST_S and not touched_by(row):
            ended = f"commands ended after {row['commanded_s']:.3f} s"
            found.append(f"at rest after {row['rest_s']:.3f} s, {ended}")
        if row["way"] == "released" and not row["goes_on"]:
            found.append("did not follow the switch again")
        if row["way"] != "released" and "lead" not in row["needs_start"]:
            found.append(f"needs no new start: {row['needs_start']!r}")
        return found
    if row["refused"]:
        found.append(f"the hand-back was refused: {row['refused']}")
    if row["mode"] == "person" and not set(row["who"]) <= {"person", "nobody"}:
        found.append(f"the policy acted while a person led: {row['who']}")
    if is_timed and row["mode"] == "blend" and "blend" not in row["who"]:
        found.append(f"no correction acted: {row['who']}")
    if row["went_on"] is None:
        found.append("the policy did not go on")
    elif is_timed and row["went_on"][1] > BORDER_S:
        found.append(f"went on {row['went_on'][1] * 1e3:.0f} ms after its action was sent")
    return found


def touched_by(row: dict[str, Any]) -> list[str]:
    """What the arm touched while it moved late, in one trial."""
    return list(row.get("late_motion", {}).get("touched", ()))


def faults_of_commands(sent: dict[str, Any] | None, unknown: int) -> list[str]:
    """What control has commanded that it must not; judged on any machine."""
    if sent is None:
        return ["no command was seen"]
    found = [
        f"commanded {name} {sent[name]:.3f} of the limit"
        for name in ("velocity", "acceleration")
        if sent[name] > ROUNDING
    ]
    return [*found, f"{unknown} commands came from nowhere"] if unknown else found


def spread(values: list[float], digits: int = 2) -> str:
    """Median, 99th percentile and worst."""
    if not values:
        return "none"
    at = np.percentile(values, (50, 99, 100))
    return ", ".join(
        f"{n} {v:.{digits}f}" for n, v in zip(("median", "p99", "worst"), at, strict=True)
    )


def report(rows: list[dict[str, Any]]) -> bool:
    """Print the results in the ledger; returns whether no trial had a fault."""
    good = True
    for part in ("takeovers", "lost"):
        mine = [row for row in rows if row["part"] == part]
        judged = [row for row in mine if "broken" not in row]
        wrong = {row["seed"]: faults for row in judged if (faults := faults_of(row))}
        good = good and not wrong
        timed = [row for row in judged if row["held_up_s"] <= HELD_UP_S]
        print(
            f"{part}: {len(judged)} judged, {len(timed)} of them with a machine not held up; "
            f"{len(mine) - len(judged)} broken, {len(wrong)} wrong"
        )
        for seed, faults in wrong.items():
            print(f"  {seed}: {'; '.join(faults)}")
        if part == "takeovers" and judged:
            tell_motions([row for row in judged if row["all"]])
        for row in judged if part == "lost" else ():
            if row["rest_s"] > REST_S and (things := touched_by(row)):
                late = row["late_motion"]
                print(
                    f"  {row['seed']}: touches {', '.join(things)}: at rest after "
                    f"{row['rest_s']:.3f} s, {late['speed_rad_s']:.3f} rad/s, "
                    f"{late['way_rad']:.4f} rad"
                )
        for way in WAYS if part == "lost" else ():
            for what, found in (("all", judged), ("timed", timed)):
                rests = [row["rest_s"] for row in found if row["way"] == way]
                print(f"  {way}, {what}: n {len(rests)}, at rest after [s] {spread(rests, 3)}")
    return good


def tell_motions(rows: list[dict[str, Any]]) -> None:
    """Print the motions at hand-overs beside those under the policy alone."""
    for name in ("step_rad_s", "acceleration", "jerk_rad_s3"):
        alone = [window[name] for row in rows for window in row["alone"]]
        print(f"  {name}, the policy alone ({len(alone)} windows): {spread(alone)}")
        for mode in ("person", "blend"):
            for span in ("taken", "back"):
                found = [row[span][name] for row in rows if row["mode"] == mode and row[span]]
                if found:
                    print(f"    {mode}, {span} ({len(found)}): {spread(found)}")
    for name in ("step_rad_s", "acceleration", "held_rad_s"):
        for span in ("alone", "taken", "back", "all"):
            found = [row["sent"][span][name] for row in rows if row["sent"][span]]
            print(f"  commanded {name}, {span} ({len(found)}): {spread(found, 3)}")
    velocity = [row["all"]["velocity"] for row in rows]
    later = [row["went_on"][0] for row in rows if row["went_on"]]
    if rows:
        print(f"  velocity as a share of the limit: {spread(velocity)}")
        print(f"  goes on after the hand-back was asked for [s]: {spread(later)}")
