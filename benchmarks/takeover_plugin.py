"""Notes each command of control after its limits, with the time and the measured posture for which
it was computed.

The time is the one that the limits used. One that is read beside it is late by as long as the
process is kept from running in between: 3 ms in a trial, which looked like 1.16 of the limit.
"""

from __future__ import annotations

import json
import threading
import time
from pathlib import Path

from rn_standard.control.module import ControlModule
from roboneuron import F64, Feature, FeatureSpec, JointCommand, hookimpl
from roboneuron.node import LimitedCommand, Module, ModuleHost

FILE = "limited.jsonl"
"""In the state directory; times in ns since 1970."""


class Notes(Feature[None]):
    """Adds nothing to the server."""


class CommandNotes:
    """Writes the commands of one control."""

    def __init__(self, control: ControlModule) -> None:
        path = Path(control.node.settings.state_directory) / FILE
        self._lines = path.open("a", buffering=1, encoding="utf-8")
        control.node.resources.callback(self._lines.close)
        self._control = control
        self._offset_ns = time.time_ns() - time.monotonic_ns()
        self._read_clock, self._newest = control.clock, threading.local()
        control.clock = self._clock

    def _clock(self) -> float:
        # a hold reads it in another thread
        self._newest.at_s = at_s = self._read_clock()
        return at_s

    def note(self, limited: LimitedCommand) -> None:
        """Called once the limits were applied, before the command is sent."""
        command, control = limited.command, self._control
        joints = control.watched.joints
        if not isinstance(command, JointCommand) or joints is None:
            return
        row = {
            "at_ns": round(self._newest.at_s * 1e9) + self._offset_ns,
            "is_lost": limited.reference_lost,
            "duration_s": command.duration_s,
            "target": self._arm(command.names, command.position),
            "measured": self._arm(joints.names, joints.position),
        }
        self._lines.write(json.dumps(row) + "\n")

    def _arm(self, names: tuple[str, ...], position: F64) -> list[float]:
        found = dict(zip(names, position.tolist(), strict=True))
        return [found[name] for name in self._control.profile.arm_joints]


def join(host: ModuleHost) -> None:
    """See `FeatureSpec.on_join`."""
    if host.settings.kind == "control":
        host.on_configured.append(_extend)


def _extend(module: Module) -> None:
    if isinstance(module, ControlModule):
        module.on_limited.append(CommandNotes(module).note)


@hookimpl
def roboneuron_features() -> tuple[FeatureSpec, ...]:
    """The feature."""
    return (
        FeatureSpec(
            name="takeover-notes",
            summary="Notes what control has sent.",
            target="takeover_plugin:Notes",
            on_join="takeover_plugin:join",
        ),
    )
