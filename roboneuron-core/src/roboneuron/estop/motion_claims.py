"""Claims on the motion of robots: a robot is moved by one call at a time, or by the policy while it
has an instruction.

The later request is refused. A stop ends both, see `MotionStarts`; a policy without an instruction
sends nothing and claims nothing. In front of the driver the robot module keeps everybody else from
an arm that the holder of a claim commands (`roboneuron.modules.command_guard`).
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from roboneuron.errors import RefusedError
from roboneuron.gate import StillReason
from roboneuron.supervisor.health import Modules, ModuleView

FREE = "Wait for its end, or call stop_motion: it ends whatever moves."
"""Hint of a request that is refused because something else moves the robot."""


def _taken(message: str) -> StillReason:
    """Why a request is refused while something else moves the robot."""
    return StillReason(rank="claim", rule="ownership", message=message, hint=FREE)


@dataclass(kw_only=True, eq=False)
class Claim:
    """Claim of one call; used by the thread that plays its motion, and ended from any.

    Attributes:
        robot: name of the robot.
        what: the tool, for messages.
        halt: set when the motion has to end.
        topic: what it uses, of a call that moves nothing; empty for the robot's motion.
        is_lead: a person leads: control lets the person or the policy act.
        end_reason: why it was ended from outside; empty if it was not.
        stop_now: sends the stop message; set while there is one to send. The emergency stop calls
            it on the triggering thread, independent of the thread that plays the motion, which
            sends it again when it runs.
        began_s: monotonic time.
    """

    robot: str
    what: str
    halt: threading.Event
    topic: str = ""
    is_lead: bool = False
    end_reason: str = ""
    stop_now: Callable[[], object] = lambda: None
    began_s: float = field(default_factory=time.monotonic)

    @property
    def moves(self) -> bool:
        """Whether it moves the robot."""
        return not self.topic

    @property
    def sentence(self) -> str:
        """What moves the robot."""
        return f"{self.what} moves {self.robot!r} now."

    def end(self, reason: str) -> None:
        """End the motion now; callable from any thread."""
        self.end_reason = reason
        self.halt.set()


class MotionClaims:
    """The claims on the robots of one server. Usable from any thread.

    Attributes:
        instruction: by which the policy claims its robot; empty if it has none.
    """

    def __init__(self, modules: Modules) -> None:
        """Args:
        modules: whether there is a policy, and whose.
        """
        self._modules = modules
        # Taken before the lock of `MotionStarts`, which registers an instruction inside `admit`.
        self._lock = threading.Lock()
        self._idle = threading.Condition(self._lock)
        self._held: dict[tuple[str, str], Claim] = {}
        self.instruction = ""

    @property
    def motions(self) -> tuple[str, ...]:
        """What moves a robot now, a phrase each."""
        now_s = time.monotonic()
        found = [
            f"{claim.what} of {claim.robot!r} (for {now_s - claim.began_s:.1f} s)"
            for claim in self._moving()
        ]
        if self._policy() is not None:
            found.append(f"the policy with the instruction {self.instruction!r}")
        return tuple(found)

    @property
    def is_moving(self) -> bool:
        """True if a call moves a robot now."""
        return bool(self._moving())

    def policy(self, robot: str, namespace: str) -> str:
        """A sentence on the policy that moves the robot now; empty without one."""
        view = self._policy() if self.instruction else None
        if view is None or view.plan is None or view.plan.config.namespace != namespace:
            return ""
        backend = view.plan.names.get("backend", "")
        return f"The policy {backend!r} moves {robot!r}: {self.instruction!r}."

    def still_reason(
        self, robot: str, namespace: str, *, is_lead: bool = False
    ) -> StillReason | None:
        """What else moves the robot now; None if it is free.

        Args:
            robot, namespace: the robot.
            is_lead: asked for a leading person, who need not wait for the policy.
        """
        if not is_lead and (policy := self.policy(robot, namespace)):
            return _taken(policy)
        other = self._held.get((robot, ""))
        return None if other is None else _taken(other.sentence)

    def still_reasons(self) -> Iterator[StillReason]:
        """What moves a robot now. A lead says itself whose it is."""
        view = self._policy()
        if view is not None and view.plan is not None:
            config = view.plan.config
            yield _taken(self.policy(config.robot.name, config.namespace))
        for claim in self._moving():
            if not claim.is_lead:
                yield _taken(claim.sentence)

    @contextmanager
    def admit(self, instruction: str) -> Iterator[None]:
        """Let the policy begin an instruction; nothing else can claim a robot within the block.

        Raises:
            RefusedError: a call moves a robot, which goes on. A lead does not count.
        """
        with self._lock:
            for claim in self._moving() if instruction else ():
                if not claim.is_lead:
                    raise _taken(claim.sentence).refusal()
            yield

    @contextmanager
    def hold(self, claim: Claim, check_free: Callable[[], object]) -> Iterator[None]:
        """Let a call hold a claim within the block.

        Args:
            claim: what it claims.
            check_free: raises RefusedError while something else moves the robot.

        Raises:
            RefusedError: as `check_free`, or another call uses the same topic.
        """
        key = claim.robot, claim.topic
        with self._lock:
            check_free()
            if key in self._held:
                raise RefusedError(
                    f"{self._held[key].what} uses {claim.topic} now.",
                    hint="Wait for its end.",
                    rule="ownership",
                )
            self._held[key] = claim
        try:
            yield
        finally:
            with self._idle:
                del self._held[key]
                self._idle.notify_all()

    def stop_now(self) -> None:
        """Send the end of each motion, because the stop was triggered in this process."""
        for claim in self._all():
            claim.stop_now()

    def wake(self) -> None:
        """Let the threads that play motions check at once whether these have to end."""
        for claim in self._all():
            claim.halt.set()

    def end_all(
        self, reason: str, timeout_s: float, which: Callable[[Claim], bool] = lambda claim: True
    ) -> bool:
        """End every motion (of the selected claims) and wait; return False if one did not end in
        time.
        """
        with self._idle:
            ended = [claim for claim in self._all() if which(claim)]
            for claim in ended:
                claim.end(reason)
            return self._idle.wait_for(
                lambda: not any(claim in ended for claim in self._all()), timeout_s
            )

    def _all(self) -> list[Claim]:
        # one step of the interpreter: no lock that another thread could hold during a stop
        return list(self._held.values())

    def _moving(self) -> list[Claim]:
        return [claim for claim in self._all() if claim.moves]

    def _policy(self) -> ModuleView | None:
        """The policy that works or starts with an instruction; None without one."""
        # evaluated for every call: the whole view costs as much as the rest of the answer
        phases = ("starting", "running")
        if not self.instruction or self._modules.slot("inference").phase not in phases:
            return None
        view = self._modules.view("inference")
        return view if view.phase in phases else None
