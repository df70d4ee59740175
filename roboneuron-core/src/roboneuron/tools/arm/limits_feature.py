"""The feature: limits that a connected client tightens, and that only a person loosens."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Sequence
from contextlib import suppress

from roboneuron.contract import RobotProfile
from roboneuron.errors import NotReadyError, RoboNeuronError
from roboneuron.gate.audit import AuditRecord
from roboneuron.modules import settings
from roboneuron.modules.plugin import load_profile
from roboneuron.modules.settings import ModuleKind
from roboneuron.plugins.specs import RobotSpec
from roboneuron.server.feature import Feature
from roboneuron.server.host import Host
from roboneuron.server.tool import Tool
from roboneuron.tools.arm.limits_tools import limits_tools
from roboneuron.tools.arm.tightening import FILE_NAME, TightenedRecord, Tightening, TighteningFile

log = logging.getLogger(__name__)
_LOOK_S = 0.5
_SET_S, _START_S = 5.0, 120.0
_END_S = 2.0
_LIMITED: tuple[ModuleKind, ...] = ("control", "robot")
"""Modules that apply limits."""


class LimitsFeature(Feature[None]):
    """Adds tighten_limits and loosen_limits: control applies them to policies, the gate to direct
    motion, and the robot module the joints' share to every command.
    """

    _host: Host
    _file: TighteningFile
    _profile: RobotProfile | None = None
    _thread: threading.Thread | None = None

    def tools(self, host: Host) -> Sequence[Tool]:
        """See `Feature.tools`."""
        self._host = host
        self._file = TighteningFile(host.state_directory / FILE_NAME)
        # held until a change is in force, sent to the modules and stored, so that one made in a
        # terminal does not come in between
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._record = TightenedRecord(tightening=Tightening(), who="", at_ns=0)
        robots = host.registry.specs(RobotSpec)
        if host.config.control is None or host.config.robot.name not in robots:
            return ()
        self._profile = load_profile(host.registry, host.config.robot)
        host.events.change.listen(self._on_change)
        return limits_tools(host, self.tighten, self.loosen)

    def complete(self, host: Host) -> None:
        """Apply the limits stored in the file. Raises ConfigurationError if it cannot be read."""
        found = self._file.read() if self._profile is not None else None
        if found is not None:
            self._use(found)

    def start(self, host: Host) -> None:
        """Start watching the file: a person may loosen the limits in a terminal."""
        if self._profile is not None:
            self._thread = threading.Thread(target=self._watch, name="limits", daemon=True)
            self._thread.start()

    def close(self) -> None:
        """See `Feature.close`."""
        if self._thread is not None:
            self._stop.set()
            self._thread.join(_END_S)

    def tighten(self, more: Tightening, who: str, role: str) -> None:
        """Add these limits for everything that moves the robot, until a person loosens them.

        Raises:
            InvalidInputError: nothing would be left.
            RefusedError: they are in force, but could not be stored or audited.
            NotReadyError: they are in force except in a running module that did not accept them.
        """
        with self._lock:
            both = self._record.tightening.tighter(more)
            if both == self._record.tightening:
                return
            record = TightenedRecord(tightening=both, who=who, at_ns=time.time_ns())
            self._use(record)  # first: a full disk must not keep the robot from being limited
            self._tell_modules()
            self._file.write(record)
            self._audit("tighten_limits", who, role, "tightened", more)

    def loosen(self, who: str, role: str) -> None:
        """Restore the configured limits, on a person's decision. Raises as `tighten`."""
        with self._lock:
            self._audit("loosen_limits", who, role, "loosened", self._record.tightening)
            record = TightenedRecord(tightening=Tightening(), who=who, at_ns=time.time_ns())
            self._file.write(record)
            self._use(record)
            self._tell_modules()

    def _use(self, record: TightenedRecord) -> None:
        """Put these limits in force for new modules and for the gate; direct motion ends."""
        assert self._profile is not None
        limits = record.tightening.applied(self._host.loop.base.limits, self._profile)
        self._host.modules.tightened = None if record.tightening.is_empty else limits
        self._record = record
        gate = self._host.gate
        gate.relimit()
        gate.end_motions(
            "The limits have changed.", _END_S, lambda exposed: exposed.endpoint.joint_limited
        )

    def _tell_modules(self) -> None:
        """Send the limits to every running or starting robot and control.

        Raises:
            NotReadyError: one did not accept them.
        """
        tightened = self._host.modules.tightened
        text = "" if tightened is None else tightened.model_dump_json()
        values = {settings.LIMITS_PARAMETER: text}
        refusals = []
        for kind in _LIMITED:
            try:
                refused = self._host.loop.set_parameters(kind, values, _SET_S, _START_S)
            except RoboNeuronError as error:
                refused = error.message
            if refused:
                refusals.append((kind, refused))
        if refusals:
            kind, refused = refusals[0]
            raise NotReadyError(
                f"The running {kind} did not take the limits: {refused}.",
                hint=f"They hold for direct motion and from its next start on: call stop_{kind}.",
            )

    def _on_change(self, kind: ModuleKind) -> None:
        """Send the limits to a module that was starting while they changed."""
        view = self._host.modules.view(kind)
        if kind not in _LIMITED or view.phase != "running" or view.settings is None:
            return
        if view.settings.tightened != self._host.modules.tightened:
            threading.Thread(target=self._tell_quietly, name="limits-modules", daemon=True).start()

    def _tell_quietly(self) -> None:
        try:
            with self._lock:
                self._tell_modules()
        except RoboNeuronError as error:
            log.error("%s", error)
            self._host.events.fault.tell("control", "limits", {"explanation": error.message})

    def _watch(self) -> None:
        """Check for a change made in a terminal; a file that vanished or was changed otherwise is
        written again.
        """
        while not self._stop.wait(_LOOK_S):
            with self._lock, suppress(RoboNeuronError):
                self._look()

    def _look(self) -> None:
        try:
            found = self._file.read()
        except RoboNeuronError:
            found = None
        if found is not None and found.at_ns > self._record.at_ns and found.tightening.is_empty:
            log.warning("The limits were loosened by %s.", found.who)
            self._use(found)
            self._host.events.uncalled.tell("loosen_limits", found.who, {})
            self._tell_modules()
        elif (
            found is None or found.tightening != self._record.tightening
        ) and not self._record.tightening.is_empty:
            log.error(
                "The tightened limits in %s were changed or removed; they are written again.",
                self._file.path,
            )
            self._file.write(self._record)

    def _audit(self, tool: str, who: str, role: str, verdict: str, what: Tightening) -> None:
        arguments = what.model_dump(exclude_defaults=True)
        robot = self._host.config.robot.name
        self._host.audit.write(
            AuditRecord(
                who=who, role=role, tool=tool, verdict=verdict, robot=robot, arguments=arguments
            )
        )
