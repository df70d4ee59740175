"""Evaluation of the arm's motion in a trial of bench_link_faults.py."""

from __future__ import annotations

import os
import random
import time
from collections.abc import Callable
from itertools import pairwise
from typing import Any, NamedTuple

from fault_loop import STILL_M
from link_faults import HARMLESS, ROWS, STEP_S, Site, Trial
from switch_plugin import named_by

from rn_testing.fakes.robot import gantry_profile
from rn_testing.waiting import holds_within

IMAGE_AGE_S, TAIL_AGE_S = 0.5, 0.5 + ROWS * STEP_S
BUSY_S = 0.05
"""Margin on a busy machine between the check of a row and its sending."""
STEP_M, SPEED_M_S = 0.006, 0.15
"""The policy moves by at most 3 mm in 50 ms."""
HOLDS_S, TAKES_OVER_S = 2.0, 2.0
BACK_S = 3.0
LONG_S = 2.5
"""Duration of faults from which a hold or fallback must occur."""
STOOD_S = 0.6
AGAIN_S = 60.0
REMOTE, LOCAL = 1, 2
"""Tags of the policies."""


class Row(NamedTuple):
    """A sent action.

    Attributes:
        at_s: time of the wall clock.
        age_s: age of its image at that time.
        image, tag: number of the image, and policy.
    """

    at_s: float
    age_s: float
    image: int
    tag: int


class Witness:
    """Records all actions with the age of their images, and the true joint; with send and
    measurement times, so that a busy observer has no effect.

    Args:
        node: in the robot's namespace.
    """

    def __init__(self, node: Any) -> None:
        from rclpy.qos import QoSProfile
        from sensor_msgs.msg import Image, JointState
        from std_msgs.msg import Float64MultiArray

        self._sent: list[tuple[float, int, int]] = []
        self._joints: list[tuple[float, float]] = []
        self._stamps: dict[int, float] = {}
        qos = QoSProfile(depth=200)
        node.create_subscription(Image, "camera/front/image", self._on_image, qos)
        node.create_subscription(Float64MultiArray, "action", self._on_action, qos)
        node.create_subscription(JointState, "true_joint_states", self._on_joints, qos)

    def _on_image(self, message: Any) -> None:
        number = int.from_bytes(bytes(message.data[:4]), "little")
        self._stamps[number] = _seconds(message.header.stamp)

    def _on_joints(self, message: Any) -> None:
        self._joints.append((_seconds(message.header.stamp), float(message.position[0])))

    def _on_action(self, message: Any, info: dict[str, Any]) -> None:
        named = named_by(message.data[6])
        assert named is not None, "every policy here names its images"
        self._sent.append((int(info["source_timestamp"]) / 1e9, named[0], named[2]))

    def since(self, since_s: float, tag: int | None = None) -> list[Row]:
        """Actions after that time, of one policy or of all."""
        return [
            Row(at_s, at_s - self._captured_s(image), image, by)
            for at_s, image, by in list(self._sent)
            if at_s >= since_s and tag in (None, by)
        ]

    def _captured_s(self, image: int) -> float:
        """Capture time of an image; for one lost here, the latest possible time."""
        if image in self._stamps:
            return self._stamps[image]
        later = [number for number in list(self._stamps) if number > image]
        return self._stamps[min(later)] if later else max(self._stamps.values())

    def sees(self) -> bool:
        """True if images have arrived."""
        return bool(self._stamps)

    def joints(self, since_s: float) -> list[tuple[float, float]]:
        """Time and position [m] of the first joint after that time."""
        return [place for place in list(self._joints) if place[0] >= since_s]


def _seconds(stamp: Any) -> float:
    return float(stamp.sec + stamp.nanosec / 1e9)


class Judge:
    """Evaluates one trial.

    Args:
        witness: observer of actions and the joint.
        instruct: requests motion again if the inference module needs a new start; returns the
            reason, or an empty text.
    """

    def __init__(self, witness: Witness, instruct: Callable[[], str], trial: Trial) -> None:
        self._witness, self._instruct, self._trial = witness, instruct, trial

    def goes_on(self) -> bool:
        """True if the remote policy, and nothing else, moves the arm."""
        if not self._witness.sees():
            return False
        since_s = time.time() - 0.5
        recent = self._witness.since(since_s)
        places = [x for _, x in self._witness.joints(since_s)]
        is_remote = len(recent) > 3 and all(row.tag == REMOTE for row in recent)
        return is_remote and max(places, default=0.0) - min(places, default=0.0) > STILL_M

    def run(self, site: Site) -> dict[str, Any]:
        """Cause the fault, and evaluate the trial."""
        trial, drawn = self._trial, random.Random(self._trial.number)
        told: dict[str, Any] = {**trial._asdict(), "wrong": []}
        if not self._comes_back()[0]:
            return {**told, "wrong": ["it did not go on before the fault"]}
        time.sleep(drawn.uniform(0.0, 1.0))
        lies, fault_s = site.lied(), time.time()
        lasts_s = drawn.choice((drawn.uniform(0.2, 1.0), drawn.uniform(LONG_S, 4.0)))
        with site.fault(trial.kind):
            time.sleep(lasts_s)
            end_s = time.time()
        time.sleep(0.8)  # later effects may begin a moment later
        wrong = told["wrong"]
        is_back, told["stopped"] = self._comes_back()
        if not is_back:
            wrong.append("it did not go on by its remote policy")
        told |= {"fault_s": round(end_s - fault_s, 2), "back_s": round(time.time() - end_s, 2)}
        told["load"] = round(os.getloadavg()[0], 1)
        told["connections"] = site.server.status()["robots"]
        if trial.is_spoilt and site.lied() == lies and "handshake" not in trial.kind:
            wrong.append("nothing was spoilt")
        wrong += self._motion(fault_s, told)
        wrong += self._ages(fault_s, told)
        if not told["stopped"]:
            wrong += self._places(fault_s, end_s, told)
        return told

    def _comes_back(self) -> tuple[bool, str]:
        """True if the remote policy moves the arm within AGAIN_S, and the reason of an earlier
        final stop: a server without heartbeats, as on a busy machine.
        """
        end_s, why = time.monotonic() + AGAIN_S, ""
        while not holds_within(self.goes_on, 2.0):
            why = self._instruct() or why
            if time.monotonic() > end_s:
                return False, why
        return True, why

    def _motion(self, fault_s: float, told: dict[str, Any]) -> list[str]:
        """Violations of the joint's bounds; the time at rest is stored in `told`."""
        places, wrong = self._witness.joints(fault_s - 1.0), []
        limits = gantry_profile().limits
        assert limits is not None
        if not all(limits.lower[0] <= x <= limits.upper[0] for _, x in places):
            wrong.append("a joint left its limits")
        steps = [abs(after[1] - before[1]) for before, after in pairwise(places)]
        told["step_mm"] = round(max(steps, default=0.0) * 1e3, 2)
        if told["step_mm"] > STEP_M * 1e3:
            wrong.append("the arm jumped")
        moved_s, stood_s, first, speed_m_s = fault_s, 0.0, 0, 0.0
        for (at_s, x), step_m in zip(places[1:], steps, strict=True):
            if step_m > STILL_M:
                stood_s, moved_s = max(stood_s, at_s - max(moved_s, fault_s)), at_s
            while places[first][0] < at_s - 0.2:
                first += 1
            since_s = at_s - places[first][0]
            if since_s > 0.1:
                speed_m_s = max(speed_m_s, abs(x - places[first][1]) / since_s)
        told |= {"stood_s": round(stood_s, 2), "speed_m_s": round(speed_m_s, 3)}
        if speed_m_s > SPEED_M_S:
            wrong.append("the arm was too fast")
        return wrong

    def _ages(self, since_s: float, told: dict[str, Any]) -> list[str]:
        """Violations by rows from images that are too old, or older than that of an earlier row."""
        wrong, newest = [], {REMOTE: 0, LOCAL: 0}
        rows = self._witness.since(since_s - 1.0)
        told["rows"] = len(rows)
        told["oldest_s"] = round(max((row.age_s for row in rows), default=0.0), 3)
        for row in rows:
            is_first = row.image > newest[row.tag]
            if row.image < newest[row.tag]:
                wrong.append(f"image {row.image} after {newest[row.tag]}")
            newest[row.tag] = max(newest[row.tag], row.image)
            if row.age_s > (IMAGE_AGE_S if is_first else TAIL_AGE_S) + BUSY_S:
                wrong.append(f"a row of an image of {row.age_s:.2f} s")
        return wrong[:5]

    def _places(self, fault_s: float, end_s: float, told: dict[str, Any]) -> list[str]:
        """Violations by the wrong policy moving the arm."""
        trial, wrong = self._trial, []
        local = self._witness.since(fault_s, LOCAL)
        told["took_over"] = bool(local)
        answers_ceased = trial.kind not in HARMLESS and end_s - fault_s > LONG_S
        if trial.kind == "model killed":  # it restarts within a second or two
            answers_ceased = False
        if not trial.has_fallback:
            late = [r for r in self._witness.since(fault_s + HOLDS_S) if r.at_s < end_s]
            if answers_ceased and late:
                wrong.append("it moved on without answers")
            if local:
                wrong.append("a fallback acted that is not there")
            return wrong
        if answers_ceased:
            if not local or local[0].at_s > fault_s + TAKES_OVER_S:
                wrong.append("the fallback did not take over")
            elif told["stood_s"] > STOOD_S:
                wrong.append("the arm stood although there is a fallback")
        if local:
            remote = self._witness.since(local[0].at_s, REMOTE)
            back = [row for row in remote if row.at_s > local[-1].at_s]
            told["back_after_s"] = round(back[0].at_s - local[0].at_s, 2) if back else None
            if back and back[0].at_s - local[0].at_s < BACK_S - BUSY_S:
                wrong.append("it gave back before three good seconds")
            stray = [row for row in remote if row.at_s < local[-1].at_s and row.at_s > fault_s]
            if back and len(stray) and stray[-1].at_s - local[0].at_s < BACK_S - BUSY_S:
                wrong.append("late rows of the remote policy were executed")
        return wrong
