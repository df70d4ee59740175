"""Tool play_recording: sends recorded actions through the gate to a simulated robot; only in
servers started for that.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from rn_recorder_runs.episodes import Streams, read_streams
from roboneuron import (
    ACTION_LABEL,
    ACTION_SIZE,
    Arguments,
    CallContext,
    Host,
    InvalidInputError,
    NotReadyError,
    RefusedError,
    Result,
    Tool,
    pose_from_message,
)
from roboneuron.feature import ExposedEndpoint, GateRequest, TimedCommand

if TYPE_CHECKING:
    from geometry_msgs.msg import PoseStamped

log = logging.getLogger(__name__)
F64 = NDArray[np.float64]
_MOST_GAP_S = 1.0
"""Longest pause between two recorded actions; a longer one is shortened to this, since control
holds meanwhile.
"""
_RATE_MARGIN = 1.001
"""Factor on the shortest time between two actions: the gate counts in windows, and times are
rounded.
"""
_READY_S = 10.0
_SETTLE_S = 1.0


class PlayRecording(Arguments):
    """Arguments of play_recording."""

    files: list[str] = Field(
        min_length=1, description="MCAP files of one run, on the server's host, oldest first."
    )


class PlayedRecording(Result):
    """Result of playing a recording."""

    sent: int = Field(description="actions")
    duration_s: float
    dropped: dict[str, int] = Field(description="what control did not act on, by reason")
    path_m: float = Field(description="length of the recorded path of the TCP")
    end_m: float | None = Field(
        description="distance between the TCP's last recorded and last measured position, each "
        "from its own beginning"
    )


def playing_tool(host: Host) -> Tool[PlayRecording]:
    """play_recording."""

    async def play(arguments: PlayRecording, context: CallContext) -> PlayedRecording:
        halt = threading.Event()
        return await context.run(
            lambda stage: _play(host, arguments, context, halt),
            on_cancel=halt.set,
            on_leave=halt.set,
        )

    return Tool(
        name="play_recording",
        title="Play recorded actions",
        description=(
            "Send the actions of a recorded run at their recorded pace. The robot must be "
            "simulated; control must run, "
            "and no policy. The gate judges all of them before the first is sent."
        ),
        arguments=PlayRecording,
        result=PlayedRecording,
        handler=play,
    )


def _play(
    host: Host, arguments: PlayRecording, context: CallContext, halt: threading.Event
) -> PlayedRecording:
    """Raises InvalidInputError, NotReadyError, RefusedError, StateError."""
    config = host.config
    if config.robot.driver != "simulated":
        raise RefusedError(
            f"The robot's driver is {config.robot.driver!r}: recordings are played in simulation "
            "only.",
            rule="simulation_only",
        )
    exposed = next((e for e in host.gate.exposed if e.control_input == "action"), None)
    if exposed is None or exposed.profile is None or exposed.profile.arms:
        raise NotReadyError(
            f"The robot {config.robot.name!r} has no single arm that follows TCP displacements; "
            "only those can be played."
        )
    streams = read_streams([Path(name) for name in arguments.files])
    check_playable(streams)
    requests = _motions(host, exposed, streams, context, arguments)
    host.modules.require_running("control")
    track = _TcpTrack(host, exposed)
    try:
        track.wait()
        before = _dropped(host)
        begun_s = time.monotonic()
        sent = _send(host, exposed, requests, halt)
        halt.wait(_SETTLE_S)
        duration_s = time.monotonic() - begun_s
        dropped = {reason: n - before.get(reason, 0) for reason, n in _dropped(host).items()}
    finally:
        track.close()
    path_m, end_m = _compare(streams, track.positions())
    return PlayedRecording(
        sent=sent,
        duration_s=round(duration_s, 3),
        dropped={reason: count for reason, count in dropped.items() if count > 0},
        path_m=round(path_m, 5),
        end_m=None if end_m is None else round(end_m, 5),
    )


def check_playable(streams: Streams) -> None:
    """Raise InvalidInputError if there is no action, or one of another control space than the gate
    checks.
    """
    if not streams.actions:
        raise InvalidInputError("The run holds no actions.", path="files")
    if others := {action.label for action in streams.actions} - {ACTION_LABEL}:
        raise InvalidInputError(
            f"The run holds actions of {', '.join(sorted(others))}; only TCP displacements "
            f"({ACTION_LABEL}) can be played.",
            path="files",
        )


def _motions(
    host: Host,
    exposed: ExposedEndpoint,
    streams: Streams,
    context: CallContext,
    arguments: PlayRecording,
) -> list[GateRequest]:
    """Split the actions into motions within the maximum duration; each was checked by the gate.

    Raises:
        RefusedError: the gate would refuse one of them.
    """
    messages = [action_message(action.values) for action in streams.actions]
    due_s = pace([action.sent_ns for action in streams.actions], exposed.endpoint.rate_hz)
    requests = []
    for piece in pieces(due_s, host.gate.max_duration_s):
        at_s = [due_s[i] - due_s[piece.start] for i in piece]
        request = GateRequest.of(
            context,
            "play_recording",
            exposed,
            [messages[i] for i in piece],
            arguments.given(),
            send_at_s=at_s,
        )
        verdict = host.gate.check(replace(request, simulated=True))
        if not verdict.allowed:
            raise RefusedError(
                f"A recorded action is refused, nothing was sent: {verdict.reason}",
                rule=verdict.rule,
            )
        requests.append(request)
    return requests


def _send(
    host: Host, exposed: ExposedEndpoint, requests: Sequence[GateRequest], halt: threading.Event
) -> int:
    """Play the motions in sequence; return the number of actions."""
    sent = 0
    for request in requests:
        at_s = request.send_at_s
        commands = _commands(request.messages, at_s)
        done = host.gate.play(
            exposed, request, commands, total_s=at_s[-1], timeout_s=_READY_S, halt=halt
        )
        if not done.verdict.may_send:
            raise RefusedError(
                done.verdict.reason or "The server simulates only.",
                rule=done.verdict.rule or "simulate",
            )
        sent += done.messages
    return sent


def pieces(due_s: Sequence[float], most_s: float) -> Iterator[range]:
    """Indices of the actions in motions of at most `most_s`, in order."""
    first = 0
    for index in range(1, len(due_s) + 1):
        if index == len(due_s) or due_s[index] - due_s[first] > most_s:
            yield range(first, index)
            first = index


def pace(sent_ns: Sequence[int], rate_hz: float) -> list[float]:
    """Time of each action [s]: as recorded, with shortened pauses, and within the
    endpoint's rate.
    """
    least_s = _RATE_MARGIN / rate_hz if rate_hz else 0.0
    due_s = [0.0]
    for before, now in pairwise(sent_ns):
        due_s.append(due_s[-1] + max(least_s, min((now - before) / 1e9, _MOST_GAP_S)))
    return due_s


def action_message(vector: F64) -> object:
    """Convert an action of the contract to its message."""
    from std_msgs.msg import Float64MultiArray, MultiArrayDimension, MultiArrayLayout  # heavy

    dimension = MultiArrayDimension(label=ACTION_LABEL, size=ACTION_SIZE, stride=ACTION_SIZE)
    return Float64MultiArray(layout=MultiArrayLayout(dim=[dimension]), data=vector.tolist())


def _commands(messages: Sequence[object], at_s: Sequence[float]) -> Iterator[TimedCommand]:
    begun_s = time.monotonic()
    for message, next_s in zip(messages, [*at_s[1:], at_s[-1]], strict=True):
        yield TimedCommand(message=message, due_s=begun_s + next_s)


def _dropped(host: Host) -> dict[str, int]:
    report = host.modules.view("control").report
    return dict(report.dropped_by) if report is not None else {}


def _compare(streams: Streams, measured: F64) -> tuple[float, float | None]:
    recorded = np.array([pose[:3] for _, pose in streams.poses]).reshape(-1, 3)
    if len(recorded) < 2:
        return 0.0, None
    path_m = float(np.linalg.norm(np.diff(recorded, axis=0), axis=1).sum())
    return path_m, float(np.linalg.norm(measured[-1] - measured[0] - (recorded[-1] - recorded[0])))


class _TcpTrack:
    """Measured positions of the TCP in the base frame, from its creation to `close`."""

    def __init__(self, host: Host, exposed: ExposedEndpoint) -> None:
        _ = host.graph  # first: two threads must not import rclpy at the same time
        from geometry_msgs.msg import PoseStamped  # heavy

        self._positions: list[F64] = []
        self._came = threading.Event()
        self.close = host.subscribe(PoseStamped, f"/{exposed.namespace}/ee_pose", self._take)

    def wait(self) -> None:
        """Wait for the first position. Raises NotReadyError."""
        if not self._came.wait(_READY_S):
            self.close()
            raise NotReadyError(
                "Control publishes no pose of the end effector.", hint="See get_status."
            )

    def positions(self) -> F64:
        """The received positions, float64 (n, 3) [m]."""
        return np.array(self._positions)

    def _take(self, message: PoseStamped) -> None:
        try:
            pose = pose_from_message(message)
        except InvalidInputError as error:
            log.warning("A measured pose is left out: %s", error)
            return
        self._positions.append(pose.position_m)
        self._came.set()
