"""The gate as features use it: messages are checked and sent here; no feature gets a publisher."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast

from roboneuron.direct_path import delivery
from roboneuron.direct_path.allow_list import AllowList
from roboneuron.direct_path.arbiter import ActiveMotion, MotionArbiter
from roboneuron.direct_path.fields import load_type
from roboneuron.direct_path.gate import Gate
from roboneuron.direct_path.traffic import Traffic
from roboneuron.errors import NotReadyError, RefusedError
from roboneuron.server.motion_gate import ExposedEndpoint, GateRequest, MotionClaim, TimedCommand
from roboneuron.server.verdict import Sent, Verdict

if TYPE_CHECKING:
    from unique_identifier_msgs.msg import UUID

    from roboneuron.direct_path.writer import TopicWriter
    from roboneuron.ros.link import Call

_LOOK_S = 0.02
_LATE_S = 0.25
"""Wait for a subscriber after which the gate checks the request again."""


class DirectGate:
    """Implementation of `Host.gate`; see `roboneuron.feature.MotionGate`."""

    def __init__(
        self,
        gate: Gate,
        arbiter: MotionArbiter,
        traffic: Traffic,
        allow_list: AllowList,
        max_duration_s: float,
        permit: Callable[[ExposedEndpoint, int], None] = lambda exposed, stops: None,
        is_still: Callable[[], bool] = lambda: False,
    ) -> None:
        self._permit, self._is_still = permit, is_still
        self._gate = gate
        self._traffic = traffic
        self._allow_list = allow_list
        self.max_duration_s = max_duration_s
        self.expose, self.relimit = allow_list.expose, allow_list.relimit
        self.check, self.slowdown = gate.check, gate.slowdown
        self.joint_limits = gate.joint_limits
        self.check_free, self.claim, self.end_motions = (
            arbiter.check_free,
            arbiter.claim,
            arbiter.end_all,
        )
        self._starts = arbiter.starts
        self._stops_until_now = arbiter.stops_until_now
        self.newest_joints, self.joints = traffic.newest_joints, traffic.joints
        self.is_served, self.cancel_goal = traffic.is_served, traffic.cancel_goal

    @property
    def exposed(self) -> tuple[ExposedEndpoint, ...]:
        """As `MotionGate.exposed`."""
        return self._allow_list.exposed

    def ask(self, exposed: ExposedEndpoint, request: GateRequest) -> Verdict:
        """As `MotionGate.ask`."""
        if exposed.endpoint.kind in ("service", "action"):
            self._traffic.check_server(exposed)
        try:
            self.check_free(exposed)
        except RefusedError as error:
            return Verdict(allowed=False, simulated=True, reason=str(error), rule=error.rule)
        return self._gate.check(request)

    def send_request(
        self, exposed: ExposedEndpoint, request: GateRequest, on_answer: Callable[[], None]
    ) -> tuple[Verdict, Call | None]:
        """As `MotionGate.send_request`."""
        # it changes nothing, so it is answered when simulated too
        is_query = exposed.endpoint.kind == "read"
        stops = self._stops_until_now(exposed)
        if not is_query:
            self.check_free(exposed)
        verdict = self._gate.check(request)
        if not (verdict.allowed if is_query else verdict.may_send):
            return verdict, None
        if not is_query:
            self._permit_now(exposed, stops)
        call = self._traffic.link().call(
            load_type(exposed.endpoint.type), exposed.topic, request.messages[0], on_answer
        )
        return verdict, call

    def send_goal(
        self,
        exposed: ExposedEndpoint,
        request: GateRequest,
        motion: MotionClaim,
        goal_id: UUID,
        server_s: float,
        on_feedback: Callable[[Any], None],
    ) -> tuple[Verdict, Any]:
        """As `MotionGate.send_goal`."""
        motion.check()
        stops = self._starts.arm_stops
        verdict = self._gate.check(request)  # first: a refused request must not wait for a server
        if not verdict.may_send:
            return verdict, None
        if not self.is_served(exposed):
            deadline_s = time.monotonic() + server_s
            while not self.is_served(exposed):
                if time.monotonic() >= deadline_s:
                    raise NotReadyError(
                        f"The action {exposed.topic} has no server: nothing was sent.",
                        hint="Start it.",
                    )
                motion.sleep_until(min(deadline_s, time.monotonic() + _LOOK_S))
            joints = self.newest_joints(exposed) if exposed.endpoint.joint_limited else None
            self._gate.check(replace(request, repeated=True, joints=joints))
        self._permit(exposed, stops)
        if exposed.moves:
            watch = self._gate.way_watch(request, lambda: self.newest_joints(exposed))
            if watch is not None:
                cast("ActiveMotion", motion).watch = watch.check
        motion.check()
        client = self._traffic.action_client(exposed)

        def send() -> Any:
            return client.send_goal_async(
                request.messages[0],
                feedback_callback=lambda message: on_feedback(message.feedback),
                goal_uuid=goal_id,
            )

        # rclpy registers a request after sending it: on another thread than its executor's, an
        # answer may arrive in between and be lost
        return verdict, self._traffic.link().on_executor(send)

    def publish_now(
        self, exposed: ExposedEndpoint, request: GateRequest, *, stamped: bool = False
    ) -> Sent | None:
        """As `MotionGate.publish_now`."""
        writer, endpoint = self._traffic.known_writer(exposed), exposed.endpoint
        if writer is None or request.simulated or endpoint.joint_limited or self._is_still():
            return None
        if endpoint.frame and self._gate.transforms is not None:  # it may wait for them
            return None
        matched = writer.matched()
        if not matched or writer.has_new_misfit:
            return None
        started_s = time.monotonic()
        self.check_free(exposed)
        verdict = self._gate.check(request)
        if verdict.may_send:
            writer.send(request.messages[0], stamped)
        return Sent(
            verdict=verdict,
            messages=int(verdict.may_send),
            subscribers=matched,
            duration_s=time.monotonic() - started_s,
        )

    def publish(
        self,
        exposed: ExposedEndpoint,
        request: GateRequest,
        *,
        timeout_s: float,
        stamped: bool = False,
    ) -> Sent:
        """As `MotionGate.publish`."""
        request = self._with_joints(exposed, request, timeout_s)
        if request.simulated:
            return self._asked(exposed, request)
        stops = self._stops_until_now(exposed)
        self.check_free(exposed)
        verdict = self._gate.check(request)
        writer = self._traffic.writer(exposed)
        if not verdict.may_send:
            return Sent(verdict=verdict, subscribers=writer.listening())
        matched = self._connect(exposed, writer, request, timeout_s, owned=False)
        self._permit_now(exposed, stops)
        started_s = time.monotonic()
        writer.send(request.messages[0], stamped)
        return Sent(
            verdict=verdict,
            messages=1,
            subscribers=matched,
            duration_s=time.monotonic() - started_s,
        )

    def play(
        self,
        exposed: ExposedEndpoint,
        request: GateRequest,
        commands: Iterable[TimedCommand],
        *,
        total_s: float,
        timeout_s: float,
        halt: threading.Event,
        details: Callable[[], str] = lambda: "",
    ) -> Sent:
        """As `MotionGate.play`."""
        request = self._with_joints(exposed, request, timeout_s)
        if request.simulated:
            return self._asked(exposed, request)
        with self.claim(exposed, request.tool, halt) as motion:
            stops = self._starts.arm_stops
            verdict = self._gate.check(request)
            writer = self._traffic.writer(exposed)
            if not verdict.may_send:
                return Sent(verdict=verdict, subscribers=writer.listening())
            matched = self._connect(exposed, writer, request, timeout_s, owned=True)
            self._permit(exposed, stops)
            try:
                end = delivery.run(
                    motion,
                    writer,
                    self._gate,
                    request,
                    commands,
                    joints=lambda: self.newest_joints(exposed),
                    total_s=total_s,
                    details=details,
                )
            finally:
                self._gate.release(request)
            end.check()
            return Sent(
                verdict=verdict,
                messages=end.sent,
                subscribers=matched,
                duration_s=end.after_s,
                stopped=end.ending in (delivery.Ending.STOP_MESSAGE, delivery.Ending.HOLD),
            )

    def _permit_now(self, exposed: ExposedEndpoint, stops: int) -> None:
        """Permit motion for what is sent once, unless there was a stop since the request: nothing
        else looks after this. Raises StateError, RefusedError.
        """
        self._permit(exposed, stops)
        self._gate.latch.check(" Nothing was sent.")

    def _with_joints(
        self, exposed: ExposedEndpoint, request: GateRequest, timeout_s: float
    ) -> GateRequest:
        if exposed.endpoint.joint_limited and request.joints is None:
            return replace(request, joints=self.joints(exposed, timeout_s))
        return request

    def _asked(self, exposed: ExposedEndpoint, request: GateRequest) -> Sent:
        return Sent(
            verdict=self.ask(exposed, request),
            subscribers=self._traffic.writer(exposed).listening(),
        )

    def _connect(
        self,
        exposed: ExposedEndpoint,
        writer: TopicWriter,
        request: GateRequest,
        timeout_s: float,
        *,
        owned: bool,
    ) -> int:
        started_s = time.monotonic()
        needed = exposed.require_subscriber
        matched = writer.connect(timeout_s if needed or writer.listening() else 0.0)
        if needed and not matched:
            which = f" that fits, because of {writer.misfit}" if writer.misfit else ""
            raise NotReadyError(
                f"{exposed.topic} ({exposed.endpoint.type}) has no subscriber{which}: nothing was "
                "sent.",
                hint="Start the robot, or look at list_topics.",
            )
        if time.monotonic() - started_s > _LATE_S:
            if not owned:
                self.check_free(exposed)
            joints = self.newest_joints(exposed) if exposed.endpoint.joint_limited else None
            self._gate.check(replace(request, repeated=True, joints=joints))
        return matched
