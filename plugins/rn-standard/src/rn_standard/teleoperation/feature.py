"""The feature: leads by teleoperators, each sent through the gate to control."""

from __future__ import annotations

import threading
import time
import uuid
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, cast

from rn_standard.teleoperation.hooks import TeleoperatorSpec
from rn_standard.teleoperation.lead import Lead, lead_endpoint
from rn_standard.teleoperation.rows import Acting
from rn_standard.teleoperation.samples import Teleoperator
from rn_standard.teleoperation.session import LeadSession, LeadSpeeds
from rn_standard.teleoperation.tools import LeadArm, LeadResult, lead_tools
from roboneuron import (
    CallContext,
    Feature,
    Host,
    InvalidInputError,
    RobotProfile,
    StateError,
    Tool,
)
from roboneuron.direct_path.exposed import ACTING_TOPIC
from roboneuron.feature import StillReason, build, load_profile, settings

if TYPE_CHECKING:
    from std_msgs.msg import Float64MultiArray

TELEOPERATION = "teleoperation"
"""Name of the feature."""
_TOLD_S = 2.0


class Teleoperation(Feature[None]):
    """Adds lead_arm and hand_back. Features may provide temporary teleoperators.

    Attributes:
        changes: called with an event ("taken_over", "handed_back", "lead_lost") and a sentence
            about it; from any thread.
    """

    _host: Host
    _tools: Sequence[Tool]

    def __init__(self, options: None) -> None:
        super().__init__(options)
        self.changes: list[Callable[[str, str], object]] = []
        # asking and beginning are one step, so that two people do not both begin to lead
        self._lock = threading.Lock()
        self._lent: dict[str, tuple[Teleoperator, float]] = {}
        self._lead: Lead | None = None
        self._unsubscribe: Callable[[], None] | None = None

    def tools(self, host: Host) -> Sequence[Tool]:
        """See `Feature.tools`."""
        self._host = host
        self._tools = lead_tools(self.begin, self.hand_back, self._choices)
        return self._tools

    @property
    def lead(self) -> Lead | None:
        """The running lead; None without one."""
        lead = self._lead
        return lead if lead is not None and lead.is_running else None

    def lend(self, name: str, source: Teleoperator, rate_hz: float = 50.0) -> None:
        """Offer a teleoperator under its own name, such as that of an open page."""
        with self._lock:
            self._lent = {**self._lent, name: (source, rate_hz)}

    def take_back(self, name: str) -> None:
        """Withdraw a teleoperator; a lead with it continues until its source is silent."""
        with self._lock:
            self._lent = {key: value for key, value in self._lent.items() if key != name}

    def begin(self, arguments: LeadArm, context: CallContext, halt: threading.Event) -> LeadResult:
        """Begin a lead, which ends when `halt` is set; blocks until control follows it.

        Raises:
            InvalidInputError: the teleoperator is unknown, or cannot lead this robot.
            RefusedError: another lead is running, or the gate refuses.
            StateError: control is not running.
            NotReadyError: the source or control does not answer.
        """
        host = self._host
        host.modules.require_running("control")
        host.loop.emergency_stop.check()
        with self._lock:
            for reason in self.still_reasons(context):
                raise reason.refusal()
            lead = self._made(arguments, context, halt)
            self._lead = lead
        lead.begin()
        text = host.loop.starts.instruction
        self._tell(
            "taken_over", f"{context.who} leads the arm by {arguments.source} ({arguments.mode})"
        )
        return LeadResult(
            leads=context.who, source=arguments.source, mode=arguments.mode, policy=text
        )

    def hand_back(self, context: CallContext) -> LeadResult:
        """End the lead; the policy continues with new observations. Blocks.

        Raises:
            StateError: no lead is running.
            NotReadyError: the policy does not accept its instruction again; it does not act then.
        """
        lead = self.lead
        if lead is None:
            raise StateError("Nobody leads the arm.")
        text = self._begin_anew()
        lead.hand_back()
        return LeadResult(policy=text)

    def close(self) -> None:
        """See `Feature.close`."""
        lead = self.lead
        if lead is not None:
            lead.end()
        unsubscribe, self._unsubscribe = self._unsubscribe, None
        if unsubscribe is not None:
            unsubscribe()

    def still_reasons(self, asker: CallContext | None) -> Sequence[StillReason]:
        """See `Feature.still_reasons`."""
        lead = self.lead
        if lead is None:
            return ()
        reason = StillReason(
            rank="claim",
            rule="lead",
            message=f"{lead.who} leads the arm by {lead.source_name}.",
            hint="Call hand_back first.",
        )
        return (reason,)

    @property
    def is_moving(self) -> bool:
        """See `Feature.is_moving`."""
        return self.lead is not None

    def _begin_anew(self) -> str:
        """Make the policy discard its plan from before the lead; return its instruction."""
        starts = self._host.loop.starts
        text, ticket = starts.instruction, starts.ticket
        if not text or self._host.modules.view("inference").phase != "running":
            return ""
        values = {settings.INSTRUCTION_PARAMETER: text}
        refused = self._host.loop.set_parameters("inference", values, _TOLD_S, _TOLD_S)
        if refused:
            raise StateError(f"The policy refuses to begin anew: {refused}.")
        if starts.ticket != ticket:
            # a stop or another instruction came between: the policy gets the one that is valid now
            values = {settings.INSTRUCTION_PARAMETER: starts.instruction}
            self._host.loop.set_parameters("inference", values, _TOLD_S, _TOLD_S)
        return starts.instruction

    def _made(self, arguments: LeadArm, context: CallContext, halt: threading.Event) -> Lead:
        """Create a lead without starting it. Raises as `begin`."""
        host = self._host
        robot = host.config.robot.name
        exposed = lead_endpoint(host.gate.exposed, robot)
        profile = load_profile(host.registry, host.config.robot)
        self._listen()
        source, rate_hz = self._source(arguments, profile)
        source.open(host.subscribe)
        session = LeadSession(
            uuid.uuid4().hex[:12],
            arguments.mode,
            profile,
            self._speeds(),
            time.monotonic(),
            rate_hz=rate_hz,
            scale=arguments.scale,
        )

        def may_lead() -> None:
            # a lead is a series of calls: a client that may call now may lead now
            host.tools.chain.check_permitted(self._tools[0], context)

        return Lead(
            session,
            source,
            arguments.source,
            host.gate,
            exposed,
            context,
            may_lead,
            self._on_end,
            halt,
        )

    def _speeds(self) -> LeadSpeeds:
        """Speeds of a lead, within the limits in force."""
        limits, usual = self._host.loop.limits, LeadSpeeds()
        return LeadSpeeds(
            linear_m_s=min(usual.linear_m_s, limits.max_speed_m_s),
            angular_rad_s=min(usual.angular_rad_s, limits.max_turn_rad_s),
        )

    def _source(self, arguments: LeadArm, profile: RobotProfile) -> tuple[Teleoperator, float]:
        lent = self._lent.get(arguments.source)
        if lent is not None:
            return lent
        registry = self._host.registry
        if arguments.source not in registry.specs(TeleoperatorSpec):
            names = ", ".join(self._choices()) or "none"
            raise InvalidInputError(
                f"There is no teleoperator {arguments.source[:60]!r}; there are: {names}.",
                path="source",
            )
        spec = registry.get(TeleoperatorSpec, arguments.source)
        if spec.gives == "joint_position" and arguments.mode == "blend":
            raise InvalidInputError(
                f"{spec.name!r} gives positions, which cannot be added to a policy's actions.",
                hint="Lead with mode = 'person', or by a source of velocities.",
                path="mode",
            )
        options = self._host.config.options(spec.name)
        return cast("Teleoperator", build(spec, options, profile)), spec.rate_hz

    def _choices(self) -> dict[str, str]:
        specs = self._host.registry.specs(TeleoperatorSpec)
        lent = dict.fromkeys(self._lent, "A page that is open.")
        return {**{name: spec.summary for name, spec in specs.items()}, **lent}

    def _listen(self) -> None:
        if self._unsubscribe is None:
            from std_msgs.msg import Float64MultiArray  # heavy

            self._unsubscribe = self._host.subscribe(
                Float64MultiArray, ACTING_TOPIC, self._on_acting
            )

    def _on_acting(self, message: Float64MultiArray) -> None:
        lead = self._lead
        if lead is not None:
            lead.note(Acting.from_message(message))

    def _on_end(self, lead: Lead) -> None:
        if not lead.reason:
            self._tell("handed_back", f"{lead.who} leads no more")
            return
        text = f"{lead.who} leads no more: {lead.reason}"
        self._tell("lead_lost", text)
        self._host.events.fault.tell("control", "lead_lost", {"explanation": text})

    def _tell(self, what: str, text: str) -> None:
        for listener in self.changes:
            listener(what, text)
