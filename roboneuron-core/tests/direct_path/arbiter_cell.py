"""A motion arbiter in front of two robots, on a clock of the test."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from roboneuron.direct_path.arbiter import MotionArbiter
from roboneuron.direct_path.gate import Gate
from roboneuron.estop.motion_claims import MotionClaims
from roboneuron.feature import ExposedEndpoint


class Halt(threading.Event):
    """Waits on the clock of the test."""

    def __init__(self, clock: Any) -> None:
        super().__init__()
        self.clock = clock
        self.waits_s: list[float] = []
        self.on_wait: Callable[[], object] = lambda: None

    def wait(self, timeout: float | None = None) -> bool:
        assert timeout is not None
        self.waits_s.append(round(timeout, 6))
        self.clock.now_s += timeout
        self.on_wait()
        return self.is_set()


class Claims(MotionClaims):
    """Claims beside policies of the test, a sentence each."""

    def __init__(self) -> None:
        nothing: Any = None
        super().__init__(nothing)
        self.policies: dict[str, str] = {}

    def policy(self, robot: str, namespace: str) -> str:
        return self.policies.get(robot, "")


class Starts:
    """What has stopped the robot."""

    def __init__(self) -> None:
        self.claims = Claims()
        self.arm_stops = 3
        self.reason = ""
        self.looks = 0

    def look(self) -> None:
        self.looks += 1


class Cell:
    """An arbiter in front of two robots."""

    def __init__(self, gate: Gate, clock: Any) -> None:
        self.gate = gate
        self.clock = clock
        self.starts: Any = Starts()
        self.policies = self.starts.claims.policies
        gate.latch.on_press.append(self.starts.claims.stop_now)
        gate.latch.on_pressed.append(self.starts.claims.wake)
        self.followed = [False]
        self.asked: list[str] = []
        self.arbiter = MotionArbiter(gate, self.starts, self.is_followed, 0.05)
        self.halt = Halt(clock)

    def is_followed(self, exposed: ExposedEndpoint) -> bool:
        self.asked.append(exposed.label)
        return self.followed.pop(0) if len(self.followed) > 1 else self.followed[0]

    def claim(self, exposed: ExposedEndpoint, what: str = "a test") -> Any:
        return self.arbiter.claim(exposed, what, self.halt)
