"""A robot for tests of tasks, by a clock of its own: an arm that moves while its policy has an
instruction.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

from rn_standard.tasks.snapshot import Snapshot
from rn_standard.tasks.task_robot import PolicyState
from roboneuron.errors import NotReadyError
from roboneuron.server.tool import Picture

PICTURE = Picture(data=b"picture", mime_type="image/jpeg")


@dataclass
class FakeCell:
    """Follows the protocol `TaskRobot`.

    Attributes:
        script: called at each look with the cell and the number of seconds since the attempt began;
            returns the snapshot's fields that the test cares about.
        halted: the task is to end.
        acts: its policy has acted.
        refuses: attempts from this number on cannot begin.
    """

    script: Callable[[FakeCell, float], dict[str, object]] = lambda cell, t: {}
    halted: bool = False
    refuses: int = 99
    time_s: float = 0.0
    moving: bool = False
    acts: bool = True
    began: int = 0
    began_s: float = 0.0
    failure: str = ""
    taken: str = ""
    led: str = ""
    ended_s: float | None = None
    on_wait: Callable[[FakeCell], object] = lambda cell: None
    looks: list[Snapshot] = field(default_factory=list)

    def now_s(self) -> float:
        return self.time_s

    def wait(self, seconds: float) -> bool:
        self.time_s += seconds
        self.on_wait(self)
        return self.halted

    def begin(self, instruction: str) -> None:
        if self.began + 1 >= self.refuses:
            raise NotReadyError("the backend is gone")
        self.began += 1
        self.began_s = self.time_s
        self.failure = ""
        self.moving = not self.halted

    def policy(self) -> PolicyState:
        return PolicyState(
            has_acted=self.acts, failure=self.failure, taken=self.taken, led=self.led
        )

    def look(self) -> Snapshot:
        still_s = 0.0 if self.moving else 10.0
        base = Snapshot(now_s=self.time_s, still_s=still_s, joints={"a": 0.0}, policy_done=False)
        snapshot = replace(base, **self.script(self, self.time_s - self.began_s))
        self.looks.append(snapshot)
        return snapshot

    def end(self) -> None:
        if self.moving:
            self.ended_s = self.time_s
        self.moving = False

    def evidence(self, when: str) -> tuple[Picture, ...]:
        return (PICTURE,)
