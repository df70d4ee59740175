"""Connection of the driver to the arm: a separate process answers the arm at 1 kHz; this one only
sends targets.
"""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import threading
import time
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rn_robot_fr3.fci import faults
from rn_robot_fr3.fci.options import FciDriverOptions
from rn_robot_fr3.fci.planner import (
    ACCELERATION_LIMIT_RAD_S2,
    JERK_LIMIT_RAD_S3,
    STOP_ACCELERATION_RAD_S2,
    VELOCITY_LIMIT_RAD_S,
    ArmPlan,
)

F64 = NDArray[np.float64]

PORT = 1337
"""TCP port of the FCI; libfranka has no other."""
_PROBE_S = 3.0
_ANSWER_S = 8.0
_START_S = 30.0
"""Start time of a Python process on a busy machine."""
_SILENT = "Timeout"
"""Kind of the error without any answer."""
_STOP_S = 5.0
_BRAKING_S = 0.6
"""Longer than any stop: 2.6 rad/s at 9 rad/s^2 takes 0.3 s."""
_LOOK_S = 0.002
_ALIVE_S = 0.02
_STALE_S = 1.5
"""Age of a state above which the control process counts as hung. It exceeds the second after which
libfranka itself reports a silent robot with the cause.
"""
_MESSAGE_BYTES = 65536


class ClientError(Exception):
    """Exception of the client library in the control process.

    Attributes:
        kind: name of its class, such as "ControlException".
    """

    def __init__(self, kind: str, text: str) -> None:
        super().__init__(text)
        self.kind = kind


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class FciState:
    """Measured state from the control box.

    Attributes:
        received_s: monotonic time at which it came from the control process.
        position, velocity, torque: float64 (7,) [rad, rad/s, Nm].
        external_torque: float64 (7,), filtered [Nm].
        wrench: float64 (6,), external force [N] and torque [Nm] at the stiffness frame, in the base
            frame.
        tcp_m, tcp_xyzw: float64 (3,) and (4,), position and unit quaternion of the end effector
            configured in Desk, in the base frame.
        mode: libfranka's RobotMode, such as "Idle".
        errors: currently set error flags.
        success_rate: share of the last 100 commands that were in time; 0 if none are sent.
        silences: number of stops because this process was silent.
        missed_cycles, longest_gap: cycles without a state over all motions, and longest sequence of
            them.
    """

    received_s: float
    position: F64
    velocity: F64
    torque: F64
    external_torque: F64
    wrench: F64
    tcp_m: F64
    tcp_xyzw: F64
    mode: str
    success_rate: float
    errors: tuple[str, ...] = field(default=())
    missed_cycles: int = 0
    longest_gap: int = 0
    silences: int = 0


class FciArm:
    """One connection, in a separate process; methods raise `ClientError` unless stated otherwise.

    Attributes:
        refusal: reason why the control box refused its settings; empty if it accepted them.
    """

    def __init__(self, options: FciDriverOptions) -> None:
        self._options = options
        self._process: subprocess.Popen[bytes] | None = None
        self._link: socket.socket | None = None
        self._news = threading.Condition()
        self._newest: dict[str, Any] | None = None
        self._answers: dict[int, ClientError | None] = {}
        self._ended: ClientError | None = None
        self._number = self._aimed = 0
        self._alive_s = self._received_s = 0.0
        self._is_stopping = False
        self.refusal = ""

    def connect(self) -> None:
        """Connect again, and set thresholds and load if the arm's mode allows it; see `refusal`.

        Raises:
            ConfigurationError, NotReadyError: it failed; tells what to do.
        """
        self.close()  # first, because the control box serves one client
        host = self._options.host
        try:
            socket.create_connection((host, PORT), _PROBE_S).close()
        except OSError as error:
            raise faults.unreachable(host, str(error.strerror or error)) from error
        self._start()
        try:
            self._ask("hello", _START_S)
            self._ask(
                "connect",
                self._options.connect_timeout_s,
                host=host,
                is_required=self._options.realtime == "required",
                stop_acceleration=STOP_ACCELERATION_RAD_S2.tolist(),
                stop_jerk=JERK_LIMIT_RAD_S3.tolist(),
            )
            self.configure()
        except ClientError as error:
            self._kill()
            if error.kind == _SILENT:
                raise faults.silent(host, self._options.connect_timeout_s) from None
            raise faults.while_connecting(error, host) from error

    def configure(self) -> None:
        """Set thresholds and load; a refusal raises no error but sets `refusal`."""
        options = self._options
        try:
            self._ask(
                "configure",
                _ANSWER_S,
                torque_nm=options.collision_torque_nm,
                force_n=options.collision_force_n,
                load_kg=options.load_kg,
                centre_m=list(options.load_centre_m),
            )
        except ClientError as error:
            if error.kind != "CommandException":
                raise
            self.refusal = str(error).split("\n")[0]
            return
        self.refusal = ""

    def read(self) -> FciState:
        """Return the newest state, at most 8 ms old while the arm answers.

        Raises:
            ClientError: the error that ended a motion, once; no state, or only an outdated one.
        """
        self._say_alive()
        with self._news:
            ended, self._ended = self._ended, None
            state, received_s = self._newest, self._received_s
        if ended is not None:
            raise ended
        if state is None:
            raise ClientError("NetworkException", "the control process has no state of the robot.")
        age_s = time.monotonic() - received_s
        if age_s > _STALE_S:
            # libfranka may wait without a bound, for example for the end of a motion
            raise ClientError(
                "NetworkException", f"the control process has sent no state for {age_s:.1f} s."
            )
        frame = np.array(state["O_T_EE"]).reshape(4, 4).T
        return FciState(
            received_s=received_s,
            position=np.array(state["q"]),
            velocity=np.array(state["dq"]),
            torque=np.array(state["tau_J"]),
            external_torque=np.array(state["tau_ext_hat_filtered"]),
            wrench=np.array(state["O_F_ext_hat_K"]),
            tcp_m=frame[:3, 3],
            tcp_xyzw=quaternion(frame[:3, :3]),
            mode=state["mode"],
            success_rate=float(state["rate"]),
            errors=tuple(state["errors"]),
            missed_cycles=state["missed"],
            longest_gap=state["longest"],
            silences=state["silences"],
        )

    @property
    def is_moving(self) -> bool:
        """True if the control loop runs, or is about to start."""
        state = self._newest
        return state is not None and (state["moving"] or state["number"] < self._aimed)

    @property
    def is_realtime(self) -> bool:
        """True if the control process has SCHED_FIFO scheduling."""
        return bool(self._newest and self._newest["realtime"])

    def go(self, plan: ArmPlan) -> None:
        """Move to the plan's target; replaces the previous motion without a jump in acceleration.
        See `await_rest`.
        """
        factor = self._options.dynamics_factor
        self._is_stopping = False
        self._number += 1
        self._aimed = self._number
        self._send(
            {
                "do": "go",
                "number": self._number,
                "target": plan.target.tolist(),
                "velocity": (plan.velocity_factor * VELOCITY_LIMIT_RAD_S).tolist(),
                "acceleration": (factor * ACCELERATION_LIMIT_RAD_S2).tolist(),
                "jerk": (factor * JERK_LIMIT_RAD_S3).tolist(),
            }
        )

    def stop(self) -> None:
        """Brake with the limits' acceleration and jerk, then end the control loop; returns
        immediately.
        """
        if self.is_moving and not self._is_stopping:
            self._send({"do": "brake"})
            self._is_stopping = True

    def await_rest(self) -> None:
        """Wait for the end of a stop; return immediately if there is none."""
        deadline_s = time.monotonic() + _BRAKING_S
        while self._is_stopping and self.is_moving and time.monotonic() < deadline_s:
            time.sleep(_LOOK_S)

    def recover(self) -> None:
        """Clear the errors of a reflex; until then, settings are refused."""
        with self._news:
            self._ended = None
        self._ask("recover", _ANSWER_S)
        self.configure()

    def close(self) -> None:
        """Stop and disconnect; may be called twice."""
        process, link = self._process, self._link
        if process is None or link is None:
            return
        with suppress(OSError):
            link.shutdown(socket.SHUT_WR)  # the process brakes and ends
        with suppress(subprocess.TimeoutExpired):
            process.wait(_STOP_S)
        self._kill()

    def _start(self) -> None:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        module = "rn_robot_fr3.fci.control_process"
        command = [sys.executable, "-P", "-m", module, str(theirs.fileno())]
        with theirs:
            self._process = subprocess.Popen(
                command, pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL
            )
        self._link, self._newest, self._ended, self._is_stopping = ours, None, None, False
        self._aimed = 0
        self._answers.clear()
        threading.Thread(target=self._listen, args=(ours,), name="fci-arm", daemon=True).start()

    def _listen(self, link: socket.socket) -> None:
        """Process messages of the control process until it ends."""
        while True:
            try:
                message = link.recv(_MESSAGE_BYTES)
            except OSError:
                message = b""
            with self._news:
                if self._link is not link:
                    return
                if not message:
                    self._newest = None
                    self._ended = self._ended or ClientError(
                        "NetworkException", "the control process has ended."
                    )
                    self._news.notify_all()
                    return
                self._take(json.loads(message))

    def _take(self, told: dict[str, Any]) -> None:
        if "answer" in told:
            self._answers[told["answer"]] = (
                ClientError(told["kind"], told["text"]) if told["kind"] else None
            )
            self._news.notify_all()
        elif "ended" in told:
            self._aimed = 0
            self._ended = ClientError(told["ended"], told["text"])
        else:
            self._newest, self._received_s = told, time.monotonic()

    def _ask(self, what: str, limit_s: float, **arguments: object) -> None:
        """Send a request to the process and wait for its answer."""
        self._number += 1
        number = self._number
        self._send({"do": what, "number": number, "arguments": arguments})
        with self._news:
            if not self._news.wait_for(lambda: number in self._answers or self._is_gone(), limit_s):
                raise ClientError(
                    _SILENT, f"the control process did not answer {what!r} within {limit_s:g} s."
                )
            error = self._answers.pop(
                number, ClientError("NetworkException", "the control process has ended.")
            )
        if error is not None:
            raise error

    def _is_gone(self) -> bool:
        return self._process is None or self._process.poll() is not None

    def _say_alive(self) -> None:
        now_s = time.monotonic()
        if now_s - self._alive_s >= _ALIVE_S:
            self._alive_s = now_s
            with suppress(ClientError):  # `read` reports the cause
                self._send({"do": "alive"})

    def _send(self, message: dict[str, object]) -> None:
        if self._link is None:
            raise ClientError("NetworkException", "there is no control process.")
        try:
            # non-blocking, because the driver's lock is held, which a stop also needs
            self._link.send(json.dumps(message).encode(), socket.MSG_DONTWAIT)
        except BlockingIOError as error:
            raise ClientError(
                "NetworkException", "the control process does not read its messages."
            ) from error
        except OSError as error:
            raise ClientError(
                "NetworkException", f"the control process has ended ({error.strerror})."
            ) from error

    def _kill(self) -> None:
        process, link = self._process, self._link
        self._process = self._link = None
        if link is not None:
            link.close()
        if process is not None and process.poll() is None:
            process.kill()
            process.wait()


def quaternion(rotation: F64) -> F64:
    """Unit quaternion x y z w (4,) of a rotation matrix (3, 3)."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation.tolist()
    outer = np.array(
        [
            [xx - yy - zz, xy + yx, xz + zx, zy - yz],
            [xy + yx, yy - xx - zz, yz + zy, xz - zx],
            [xz + zx, yz + zy, zz - xx - yy, yx - xy],
            [zy - yz, xz - zx, yx - xy, xx + yy + zz],
        ]
    )
    values, vectors = np.linalg.eigh(outer)
    newest: F64 = vectors[:, int(np.argmax(values))]
    return newest if newest[3] >= 0.0 else -newest
