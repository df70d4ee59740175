"""The feature: builds the one gate of a server, provides it as `host.gate`, and ends every motion
that passed it.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING

from roboneuron.contract.profile import check_topic
from roboneuron.direct_path.allow_list import AllowList
from roboneuron.direct_path.arbiter import MotionArbiter
from roboneuron.direct_path.fields import load_type
from roboneuron.direct_path.gate import Gate
from roboneuron.direct_path.motion_gate import DirectGate
from roboneuron.direct_path.options import DirectPathOptions
from roboneuron.direct_path.places import FindTransform
from roboneuron.direct_path.plugin import FEATURE
from roboneuron.direct_path.traffic import Traffic
from roboneuron.direct_path.transforms import TYPE, find_transform
from roboneuron.errors import RoboNeuronError
from roboneuron.gate import StillReason
from roboneuron.server.feature import Feature
from roboneuron.server.host import Host
from roboneuron.server.motion_gate import ExposedEndpoint, MotionGate
from roboneuron.server.tool import CallContext, Tool
from roboneuron.supervisor.health import EXPLANATIONS, FAULTS, Health, ModuleView

if TYPE_CHECKING:
    from diagnostic_msgs.msg import DiagnosticArray

    from roboneuron.ros.link import RosLink

log = logging.getLogger(__name__)
_CLOSE_S = 2.0
_TRANSFORM_S = 1.0
"""Longest wait for a transform that a place needs."""
_REPORTED_S = 1.5
"""Longest delay between a hold of control and its report, on a busy machine."""


class DirectPath(Feature[DirectPathOptions]):
    """The gate of the direct path. It adds no tool: the tools of other features pass their messages
    to `host.gate`.

    Attributes:
        judge: decides on every request.
        arbiter: exclusive use of each robot.
        allow_list: endpoints that agents may use.
    """

    judge: Gate
    arbiter: MotionArbiter
    allow_list: AllowList
    _gate: DirectGate | None = None

    @property
    def gate(self) -> MotionGate | None:
        """The gate, available from the collection of tools on."""
        return self._gate

    def still_reasons(self, asker: CallContext | None) -> Iterator[StillReason]:
        """See `Feature.still_reasons`: whether it only simulates."""
        if self.options.simulate:
            yield StillReason(
                rank="server",
                rule="simulate",
                message="[direct_path] simulate is set: what tools ask for is judged, not sent.",
                hint="A person removes it from roboneuron.toml and starts the server again.",
            )

    def tools(self, host: Host) -> Sequence[Tool]:
        """Return no tools; build the gate, which allows nothing until something is exposed. Raises
        InvalidInputError or ConfigurationError for an invalid source of transforms.
        """
        self._host = host
        self._modules = host.modules
        self.judge = Gate(
            (),
            latch=host.loop.emergency_stop.file,
            audit=host.audit,
            clock=time.monotonic,
            simulated=self.options.simulate,
            transforms=self._transforms(host),
        )
        control = host.config.control
        self.arbiter = MotionArbiter(
            self.judge,
            host.loop.starts,
            self._is_followed,
            _REPORTED_S + (0.0 if control is None else control.action_timeout_s),
            host.config.silence_s,  # as modules do
        )
        self.allow_list = AllowList(
            self.judge,
            lambda: host.config,
            lambda: host.registry,
            lambda: host.loop.limits,
            host.events.exposed.tell,
        )
        traffic = Traffic(lambda: host.link(self))
        self._gate = DirectGate(
            self.judge, self.arbiter, traffic, self.allow_list, self.options.max_duration_s,
            self._permit, host.loop.starts.are_needed,
        )  # fmt: skip
        host.events.change.listen(self._on_module)
        host.events.health.listen(HealthDiagnostics(lambda: host.link(self)).publish)
        return ()

    def _transforms(self, host: Host) -> FindTransform | None:
        """Return the function that looks up transforms; raises as `check_topic` and `load_type`."""
        topic = self.options.transforms
        if not topic:
            return None
        check_topic(topic)
        load_type(TYPE)
        place = topic if topic.startswith("/") else f"/{host.config.namespace}/{topic}"
        return lambda target, source: find_transform(
            host,
            place,
            target,
            source,
            max_age_s=self.options.transform_age_s,
            timeout_s=_TRANSFORM_S,
        )

    def complete(self, host: Host) -> None:
        """Expose the robot's profile, unless a feature has exposed others instead. Raises as
        `AllowList.expose`.
        """
        self.allow_list.refresh()

    def end_motion(self, reason: str, timeout_s: float) -> bool:
        """End every motion that passed the gate with its stop message; return False if one did not
        end in time.
        """
        return self._gate is None or self.arbiter.end_all(reason, timeout_s)

    def close(self) -> None:
        """End every motion and close the gate. Idempotent."""
        if self._gate is not None:
            self.judge.replace(())
            self.end_motion("The direct path is closed.", _CLOSE_S)

    def _permit(self, exposed: ExposedEndpoint, stops: int) -> None:
        """Permit motion again after a stop, on a client's request from after so many stops. Raises
        as `MotionStarts.permit`.
        """
        if exposed.moves and exposed.namespace == self._host.config.namespace:
            self._host.loop.starts.permit(stops)

    def _is_followed(self, exposed: ExposedEndpoint) -> bool:
        """True if control has acted since its last hold; a frozen control module reports nothing
        and reaches no hold.
        """
        view = self._modules.view("control")
        if (
            view.plan is None
            or view.plan.config.namespace != exposed.namespace
            or view.report is None
        ):
            return False
        is_turning = view.phase == "running" and view.health(time.monotonic()) not in (
            "silent",
            "stuck",
        )
        return is_turning and view.report.is_following

    def _on_module(self, kind: str) -> None:
        """Update the endpoints, because another robot has other interfaces."""
        if kind == "robot":
            try:
                self.allow_list.refresh()
            except RoboNeuronError as error:
                log.error("What the robot offers cannot be exposed: %s", error)


def direct_path(host: Host) -> DirectPath:
    """Return the direct path of a server. Raises StateError as `Host.feature`."""
    return host.feature(FEATURE.name, DirectPath)


class HealthDiagnostics:
    """Publishes every change of a module's health on /diagnostics, for modules that are frozen or
    gone.
    """

    def __init__(self, link: Callable[[], RosLink]) -> None:
        self._link = link
        self._send: Callable[[DiagnosticArray], None] | None = None

    def publish(self, view: ModuleView, before: Health, health: Health) -> None:
        """Publish one change; a listener of `Events.health`."""
        if view.plan is None:
            return
        from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue  # heavy

        from roboneuron.ros import topics

        if self._send is None:
            self._send = self._link().advertise(DiagnosticArray, topics.DIAGNOSTICS)
        level: bytes = DiagnosticStatus.OK
        if health in FAULTS:
            level = (
                DiagnosticStatus.STALE if health in ("silent", "stuck") else DiagnosticStatus.ERROR
            )
        told = DiagnosticStatus(
            level=level,
            name=f"{view.plan.config.namespace}/supervisor/{view.kind}",
            message=EXPLANATIONS[health],
            hardware_id=str(os.getpid()),
            values=[KeyValue(key="health", value=health), KeyValue(key="before", value=before)],
        )
        message = DiagnosticArray(status=[told])
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(
            time.time_ns(), 1_000_000_000
        )
        self._send(message)
